// The operator page: what the status says, in sight; what a hand asks for, to the daemon. Nothing is asked for by itself.
import { Hold } from "./jog.js";
import { Link, ask } from "./link.js";
import { Picture } from "./picture.js";
import { reach } from "./reach.js";
import { THIRDS, color, front, plan, plot, profile } from "./draw.js";
import { current, learn, speak, t, theirs } from "./texts.js";

const SPAN_MS = 600_000, SAMPLE_MS = 250;
const JOGS = [["rotate", "°"], ["height", "mm"], ["slope", "°"], ["pitch", "°"]];
const $ = (id) => document.getElementById(id);
const shown = {};
let status = null, config = null, right = null, view = "work", sampled_ms = -Infinity;
const history = { requested: [], measured: [], left: [], center: [], right: [], height: [] };
const kept = { get: (key) => { try { return localStorage.getItem(`graderd ${key}`); } catch { return null; } }, set: (key, value) => { try { localStorage.setItem(`graderd ${key}`, value); } catch { /* private */ } } };

// ---- values -----------------------------------------------------------------------------------------------------------

/** A number for people: a real minus, never −0; a dash where it is not known. */
function number(value, unit, digits = 1) {
  if (value === null || value === undefined) return "–";
  const text = value.toFixed(digits);
  return `${Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−")}${unit === "°" ? "" : " "}${unit}`.trim();
}

/** `text` into `element`, marked as English where it is not in the page's language. */
function write(element, text) {
  element.textContent = text;
  if (current() === "en" || !/[a-z]{2}/.test(text) || /[가-힣]/.test(text)) element.removeAttribute("lang");
  else element.lang = "en";
  return element;
}

/** Text into everything marked with that name; only what changed is touched. */
function put(name, text) {
  if (shown[name] === text) return;
  shown[name] = text;
  for (const element of document.querySelectorAll(`[data-v=${name}]`)) write(element, text);
}

function list(id, items) {
  const key = JSON.stringify(items);
  if (shown[id] === key) return;
  shown[id] = key;
  $(id).replaceChildren(...items.map(({ good, mild, head, more }) => {
    const item = document.createElement("li"), mark = document.createElement("i"), body = document.createElement("div"), name = document.createElement("b");
    item.className = good ? "good" : mild ? "mild" : "bad";
    mark.textContent = good ? "✓" : mild ? "○" : "✕";
    mark.setAttribute("aria-label", good ? t("met") : t("unmet"));
    mark.setAttribute("role", "img");
    body.append(write(name, head), ...more.filter(Boolean).map((text) => write(document.createElement("small"), text)));
    item.append(mark, body);
    return item;
  }));
}

// ---- the status -------------------------------------------------------------------------------------------------------

function show(next) {
  status = next;
  const rotation = next.axes.rotation ?? { requested: null, limited: null, measured: null, limited_because: "" };
  put("mode", `${next.arming ? t("arming") : t(`m_${next.mode}`)}${next.simulated ? ` · ${t("simulated")}` : ""}`);
  put("reason", theirs(next.reason));
  for (const third of THIRDS) {
    put(`ahead_${third}`, number((next.soil.ahead ?? {})[`${third}_l`] ?? next.soil[`volume_${third}_l`], ""));
    put(`carried_${third}`, number((next.soil.carried ?? {})[`${third}_l`], ""));
  }
  put("zone", t(`z_${next.soil.zone}`));
  put("soil_reason", theirs(next.soil.reason));
  put("decision", next.decision.zone === null ? t("none_yet") : `${t(`z_${next.decision.zone}`)} → ${number(next.decision.angle_deg, "°")}`);
  put("decision_reason", theirs(next.decision.reason));
  put("holding", next.holding.map(theirs).join("; "));
  put("requested", number(rotation.requested, "°"));
  put("limited", number(rotation.limited, "°"));
  put("measured", number(rotation.measured, "°"));
  put("limited_because", theirs(rotation.limited_because));
  put("height", number(next.attitude.height_mm, "mm", 0));
  put("slope", number(next.attitude.slope_deg, "°"));
  put("pitch", number(next.attitude.pitch_deg, "°"));
  put("lease", next.lease ? t("for_more", next.lease.client, next.lease.remaining_s.toFixed(1)) : t("nobody"));
  put("camera", `${theirs(next.camera.lifecycle)} ${next.camera.description}`);
  put("tick", `${next.tick.rate_hz.toFixed(0)} Hz, p99 ${next.tick.lateness_p99_ms.toFixed(1)} ms`);
  put("vehicle", next.vehicle.speed_m_per_s === null ? t("unknown_speed") : number(next.vehicle.speed_m_per_s, "m/s", 2));
  put("last_stop", next.last_stop ? theirs(next.last_stop) : t("none"));
  put("version", next.version);
  const faults = next.faults;
  $("faults-n").textContent = faults.length || "";
  const told = faults.map((f) => ({ mild: f.reaction === "warn", head: theirs(f.reads), more: [theirs(f.remedy), theirs(f.detail), `${f.name}: ${theirs(f.reaction)}, ${t("clears", theirs(f.clears))}`] }));
  list("faults", told.length ? told : [{ good: true, head: t("no_faults"), more: [] }]);
  list("readiness", next.readiness.map((r) => ({ good: r.met, mild: !r.mandatory, head: theirs(r.name), more: r.met ? [] : [theirs(r.reason), theirs(r.remedy), r.mandatory ? "" : t("may_be")] })));
  const worst = faults.find((f) => f.reaction !== "warn"), alarm = worst ? `${theirs(worst.reads)}. ${theirs(worst.remedy)}` : "";
  if ($("alarm").textContent !== alarm) write($("alarm"), alarm);
  controls();
  jogValues(next, rotation);
  remember(next, rotation);
  draw();
}

function draw() {
  if (!status || document.hidden) return;
  if (view === "work") {
    plan(status.axes.rotation);
    front(status.attitude);
    profile(status.soil);
  }
  if (view === "plots") drawPlots();
}

function remember(next, rotation) {
  const now_ms = performance.now();
  if (now_ms - sampled_ms < SAMPLE_MS) return;
  const gap = now_ms - sampled_ms > 4 * SAMPLE_MS;
  sampled_ms = now_ms;
  const values = { requested: rotation.requested, measured: rotation.measured, height: next.attitude.height_mm };
  for (const third of THIRDS) values[third] = (next.soil.ahead ?? {})[`${third}_l`] ?? next.soil[`volume_${third}_l`];
  for (const [name, points] of Object.entries(history)) {
    if (gap && points.length) points.push([now_ms - 1, null]);
    points.push([now_ms, values[name] ?? null]);
    while (points.length && now_ms - points[0][0] > SPAN_MS) points.shift();
  }
}

let plotted_ms = -Infinity;
function drawPlots() {
  const now_ms = performance.now();
  if (now_ms - plotted_ms < SAMPLE_MS) return;
  plotted_ms = now_ms;
  plot("plot-angle", [{ points: history.requested, stroke: color("ink"), wide: 1.5 }, { points: history.measured, stroke: color("center"), wide: 3 }], now_ms, SPAN_MS);
  plot("plot-soil", THIRDS.map((third) => ({ points: history[third], stroke: color(third), wide: 2.5 })), now_ms, SPAN_MS, 0);
  plot("plot-height", [{ points: history.height, stroke: color("center"), wide: 3 }], now_ms, SPAN_MS);
}

/** What is not known any more is not shown any more. */
function blank() {
  for (const element of document.querySelectorAll("[data-v]")) if (element.dataset.v !== "version") element.textContent = "–";
  for (const name of Object.keys(shown)) delete shown[name];
  for (const output of document.querySelectorAll("#jogs output")) output.textContent = "–";
  $("alarm").textContent = $("faults-n").textContent = "";
  $("faults").replaceChildren();
  $("readiness").replaceChildren();
  plan(null);
  front({ height_mm: null, slope_deg: null, pitch_deg: null });
  profile({});
  status = null;
  controls();
}

function age(age_ms, stale) {
  const was = document.body.hasAttribute("data-stale");
  document.body.toggleAttribute("data-stale", stale);
  const text = age_ms === null ? t("never") : stale ? t("heard", (age_ms / 1000).toFixed(1)) : t("live");
  if ($("heard").textContent !== text) $("heard").textContent = text;
  if (stale && !was) blank();
}

// ---- commands ---------------------------------------------------------------------------------------------------------

/** What became of a command: words of the page by their keys, and the daemon's. */
function say(...what) { write($("said"), what.filter(Boolean).map((words) => theirs(t(words))).join(". ")); }

function controls() {
  const may = right === "command" && status !== null;
  for (const button of document.querySelectorAll("[data-command]")) {
    const command = button.dataset.command, mode = status?.mode;
    const able = { arm: mode === "disarmed", disarm: mode !== "stopped" && (mode !== "disarmed" || status?.arming), manual: mode === "auto", auto: mode === "manual", reset: mode === "stopped" }[command];
    button.disabled = !(may && able);
    button.toggleAttribute("data-on", command === mode);
  }
  const byHand = may && status.mode === "manual";
  for (const button of document.querySelectorAll("#jogs button, #presets button")) if (button.disabled === byHand) button.disabled = !byHand;
}

for (const button of document.querySelectorAll("[data-command]")) {
  button.addEventListener("click", async (event) => {
    if (!event.isTrusted || button.disabled || link.stale) return;
    const command = button.dataset.command;
    // A reset clears the stop that was read, and none that came since.
    const answer = await ask("POST", "/v1/commands", { command, client: "page", ...(command === "reset" ? { stop_n: status.stop_n } : {}) });
    say(...(answer.ok ? [answer.message] : [answer.error, answer.remedy]));
  });
}

function makeJogs() {
  $("jogs").replaceChildren(...JOGS.map(([axis]) => {
    const row = document.createElement("div"), value = document.createElement("div");
    row.className = "jog";
    row.setAttribute("role", "group");
    row.setAttribute("aria-label", t(axis));
    const button = (sign) => {
      const made = document.createElement("button");
      made.type = "button"; made.disabled = true; made.id = `jog-${axis}${sign > 0 ? "+" : "-"}`;
      made.textContent = t(`${axis}${sign > 0 ? "+" : "-"}`);
      hold.attach(made, () => {
        const value = status && config ? reach(axis, sign, config, status) : null;
        return value === null ? null : { command: "jog", axis, value };
      });
      return made;
    };
    value.innerHTML = "<span></span><output></output>";
    value.querySelector("span").textContent = t(axis);
    value.querySelector("output").id = `jog-${axis}`;
    // What is done is where the hand expects it: to the left what turns or raises the left.
    row.append(button(1), value, button(-1));
    return row;
  }));
}

function jogValues(next, rotation) {
  const values = { rotate: rotation.measured, height: next.attitude.height_mm, slope: next.attitude.slope_deg, pitch: next.attitude.pitch_deg };
  for (const [axis, unit] of JOGS) {
    const output = $(`jog-${axis}`), text = number(values[axis], unit, unit === "mm" ? 0 : 1);
    if (output && output.textContent !== text) output.textContent = text;
  }
  const names = next.presets.join();
  if ($("presets").dataset.names === names) return;
  $("presets").dataset.names = names;
  $("presets").replaceChildren(...next.presets.map((name) => {
    const button = document.createElement("button");
    button.type = "button"; button.disabled = true; button.textContent = name.replaceAll("_", " "); button.lang = "en";
    hold.attach(button, () => ({ command: "preset", name }));
    return button;
  }));
  controls();
}

// ---- views, language, rights --------------------------------------------------------------------------------------------

const TABS = ["work", "move", "health", "plots"];
function open(name, focus = false) {
  view = name;
  for (const tab of TABS) {
    $(tab).hidden = tab !== name || right === null;
    const button = $(`tab-${tab}`);
    button.setAttribute("aria-selected", String(tab === name));
    button.tabIndex = tab === name ? 0 : -1;
    if (tab === name && focus) button.focus();
  }
  if (name === "move" && right === "command") hold.open(); else hold.close();
  picture.want(name === "work" && right !== null && !document.hidden);
  if (name === "plots") plotted_ms = -Infinity;
  draw();
}
for (const tab of TABS) $(`tab-${tab}`).addEventListener("click", () => open(tab));
$("tabs").addEventListener("keydown", (event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (step) open(TABS[(TABS.indexOf(view) + step + TABS.length) % TABS.length], true);
});

function tongue(language) {
  speak(language);
  kept.set("language", current());
  makeJogs();
  retell();
  learn(retell);
  $("who").textContent = right === null ? "" : t(right === "command" ? "may_command" : "read_only");
}
/** The same again, in other words. */
function retell() {
  for (const name of Object.keys(shown)) delete shown[name];
  if (status) show(status);
}
$("language").addEventListener("click", () => { hold.end("released"); tongue(current() === "en" ? "ko" : "en"); });
$("mirror").addEventListener("change", () => kept.set("mirror", $("mirror").checked ? "yes" : "no"));

async function enter(token = "") {
  const answer = await ask(token ? "POST" : "GET", "/v1/session", undefined, token ? { Authorization: `Bearer ${token}` } : {});
  if (!answer.ok) return answer.status === 401 || answer.status === 403 ? leave(token ? "login_no" : "") : setTimeout(enter, 1000);
  right = answer.right;
  $("login").hidden = true;
  $("login-said").textContent = $("token").value = "";
  $("who").textContent = t(right === "command" ? "may_command" : "read_only");
  config = await ask("GET", "/v1/config");
  picture.faces_back = config.camera?.calibration?.mounting === "facing_blade_from_front";
  $("mirror").checked = (kept.get("mirror") ?? (picture.faces_back ? "yes" : "no")) === "yes";
  link.open();
  open(view);
}

function leave(why) {
  right = null;
  hold.close();
  link.close();
  open(view);
  $("login").hidden = false;
  $("login-said").textContent = why ? t(why) : "";
}
$("login-form").addEventListener("submit", (event) => { event.preventDefault(); if ($("token").value) enter($("token").value.trim()); });
$("logout").addEventListener("click", async () => { await ask("DELETE", "/v1/session"); leave(""); });

const picture = new Picture();
const link = new Link({ onStatus: show, onAge: age, onRefused: () => leave("") });
const hold = new Hold(link, say);

document.addEventListener("visibilitychange", () => {
  if (document.hidden) { link.close(); picture.want(false); } else if (right !== null) { link.open(); open(view); }
});
// A page that comes back from the browser's memory starts from nothing.
addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
addEventListener("resize", draw);

tongue(kept.get("language") ?? (navigator.language.startsWith("ko") ? "ko" : "en"));
open("work");
const given = location.hash.slice(1);
if (given) window.history.replaceState(null, "", location.pathname);
enter(given);
