// Pictures of what the status says. A value that is not known is not drawn.
import { t } from "./texts.js";

const css = getComputedStyle(document.documentElement);
const color = (name) => css.getPropertyValue(`--${name}`).trim();
const RAD = Math.PI / 180;
export const THIRDS = ["left", "center", "right"];

/** The canvas at the screen's own pixels, cleared; its width and height in CSS pixels. */
function sheet(id) {
  const canvas = document.getElementById(id), ratio = devicePixelRatio || 1;
  const width = canvas.clientWidth, shape = (canvas.dataset.shape ??= canvas.height / canvas.width);
  const height = Math.round(width * shape);
  if (canvas.width !== Math.round(width * ratio)) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
  const draw = canvas.getContext("2d");
  draw.setTransform(ratio, 0, 0, ratio, 0, 0);
  draw.clearRect(0, 0, width, height);
  draw.lineCap = draw.lineJoin = "round";
  draw.font = "600 15px system-ui, sans-serif";
  return { draw, width, height };
}

function line(draw, points, stroke, wide, dash = []) {
  draw.beginPath();
  points.forEach(([x, y], i) => (i ? draw.lineTo(x, y) : draw.moveTo(x, y)));
  draw.strokeStyle = stroke; draw.lineWidth = wide; draw.setLineDash(dash); draw.stroke(); draw.setLineDash([]);
}

function words(draw, text, x, y, fill = color("ink"), align = "center") {
  draw.textAlign = "left"; draw.fillStyle = fill;
  const wide = draw.measureText(text).width, begin = x - { left: 0, center: wide / 2, right: wide }[align];
  draw.fillText(text, Math.max(2, Math.min(draw.canvas.clientWidth - wide - 2, begin)), y);  // on a narrow sheet, too, no word is cut
}

/** The blade from above, travel upwards: requested dashed, limited dotted, measured solid, in its thirds' colours. */
export function plan(axis) {
  const { draw, width, height } = sheet("plan");
  const x = width / 2, y = height * 0.56, half = Math.min(width * 0.4, height * 0.44);
  line(draw, [[x, height - 8], [x, 12], [x - 8, 26], [x, 12], [x + 8, 26]], color("line"), 2);
  words(draw, t("travel"), x + 14, 24, color("soft"), "left");
  for (const degrees of [-60, -30, 30, 60]) line(draw, [along(x, y, half * 1.04, degrees), along(x, y, half * 1.12, degrees)], color("line"), 2);
  if (!axis) return;
  const blade = (degrees, stroke, wide, dash) => line(draw, [along(x, y, half, degrees), along(x, y, -half, degrees)], stroke, wide, dash);
  if (axis.measured !== null) {
    THIRDS.forEach((third, i) => line(draw, [along(x, y, half * (1 - i * 2 / 3), axis.measured), along(x, y, half * (1 - (i + 1) * 2 / 3), axis.measured)], color(third), 16));
    words(draw, t("left"), ...inside(along(x, y, half * 1.02, axis.measured), width, height, -22), color("left"));
    words(draw, t("right"), ...inside(along(x, y, -half * 1.02, axis.measured), width, height, 30), color("right"));
  }
  if (axis.limited !== null) blade(axis.limited, color("alarm"), 4, [2, 8]);
  if (axis.requested !== null) blade(axis.requested, color("ink"), 3, [12, 8]);
}

/** A point of the blade, `s` from its middle towards its left end, turned counter-clockwise seen from above. */
const along = (x, y, s, degrees) => [x - s * Math.cos(degrees * RAD), y + s * Math.sin(degrees * RAD)];
const inside = ([x, y], width, height, away) => [Math.max(30, Math.min(width - 36, x)), Math.max(18, Math.min(height - 8, y + away))];

/** The blade from behind over the ground, heights five times as they are; its lean beside it. */
export function front(attitude) {
  const { draw, width, height } = sheet("front");
  const ground = height * 0.74, x = width * 0.4, half = width * 0.33, tall = height * 0.2;
  draw.fillStyle = "#d9d4c7"; draw.fillRect(0, ground, width, height - ground);
  line(draw, [[0, ground], [width, ground]], color("ink"), 2);
  words(draw, t("left"), x - half, height - 10, color("left"));
  words(draw, t("right"), x + half, height - 10, color("right"));
  const { height_mm, slope_deg, pitch_deg } = attitude;
  if (height_mm !== null && slope_deg !== null) {
    const lift = Math.max(-40, Math.min(ground - tall - 6, height_mm * height / 420));
    draw.save(); draw.translate(x, ground - lift); draw.rotate(slope_deg * RAD);
    draw.fillStyle = "#fff"; draw.fillRect(-half, -tall, 2 * half, tall);
    THIRDS.forEach((third, i) => line(draw, [[half * (-1 + i * 2 / 3), 0], [half * (-1 + (i + 1) * 2 / 3), 0]], color(third), 8));
    draw.strokeStyle = color("ink"); draw.lineWidth = 3; draw.strokeRect(-half, -tall, 2 * half, tall);
    draw.restore();
  }
  if (pitch_deg !== null) {
    draw.save(); draw.translate(width * 0.87, ground); draw.rotate(pitch_deg * RAD);
    line(draw, [[0, 0], [-8, -tall * 0.5], [0, -tall * 1.1]], color("ink"), 7);
    draw.restore();
    line(draw, [[width * 0.87, ground], [width * 0.87, ground - tall * 1.3]], color("line"), 2, [4, 6]);
    words(draw, t("tilt"), width * 0.86, ground - tall * 1.3 - 8, color("soft"));
  }
}

/** How high the soil stands along the blade, from its left end to its right; grey: not seen there. */
export function profile(soil) {
  const { draw, width, height } = sheet("profile");
  const heights = soil.profile_mm ?? [], known = heights.filter((mm) => mm !== null);
  const floor = height - 6, left = width / 4, wide = (width - left) / (heights.length || 1);
  const most = 100 * Math.ceil(Math.max(200, ...known) / 100), scale = (floor - 16) / most;
  for (let mm = 100; mm <= most; mm += 100) {
    line(draw, [[left, floor - mm * scale], [width, floor - mm * scale]], "#c9c9c4", 1);
    words(draw, `${mm} mm`, left - 8, floor - mm * scale + 5, color("soft"), "right");
  }
  heights.forEach((mm, i) => {
    const tall = mm === null ? floor - 16 : mm * scale;
    draw.fillStyle = mm === null ? "#d5d5d0" : color(THIRDS[Math.floor(i * 3 / heights.length)]);
    draw.fillRect(left + i * wide + 1, floor - tall, wide - 2, tall);
  });
  line(draw, [[left, floor], [width, floor]], color("ink"), 3);
}

/** A plot of series `{points: [[ms, value or null]], stroke, wide}` over the last `span_ms`; a gap is a gap. */
export function plot(id, series, now_ms, span_ms, floor = null) {
  const { draw, width, height } = sheet(id);
  const values = series.flatMap(({ points }) => points.map(([, value]) => value)).filter((value) => value !== null);
  let low = Math.min(floor ?? Infinity, ...values), high = Math.max(...values, -Infinity);
  if (!values.length) { low = 0; high = 1; }
  if (high - low < 5) high = low + 5;
  const room = (high - low) * 0.06, left = 46, right = width - 8, top = 8, bottom = height - 24;
  low -= floor === null ? room : 0; high += room;
  const x = (ms) => right - ((now_ms - ms) / span_ms) * (right - left), y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);
  const step = [1, 2, 5, 10, 20, 50, 100, 200].find((step) => (high - low) / step <= 5) ?? 500;
  for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
    line(draw, [[left, y(value)], [right, y(value)]], "#c9c9c4", 1);
    words(draw, String(value).replace("-", "−"), left - 6, y(value) + 5, color("soft"), "right");
  }
  for (let minutes = 0; minutes <= span_ms / 60_000; minutes += 2) words(draw, minutes ? `−${minutes} min` : "0", Math.min(right - 6, x(now_ms - minutes * 60_000)), height - 5, color("soft"), minutes === 10 ? "left" : minutes ? "center" : "right");
  for (const { points, stroke, wide } of series) {
    let piece = [];
    const finish = () => { if (piece.length > 1) line(draw, piece, stroke, wide); piece = []; };
    for (const [ms, value] of points) (value === null ? finish() : piece.push([x(ms), y(value)]));
    finish();
  }
}

export { color };
