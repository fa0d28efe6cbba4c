// The page's own words, and the daemon's (reasons, faults, remedies) in the page's language.
import { ask } from "./link.js";
import { Words } from "./words.js";

const TEXTS = {
  en: {
    connecting: "connecting …", heard: "last heard {} s ago", live: "live", never: "nothing heard yet",
    work: "Work", move: "Move", health: "Checks", plots: "Plots",
    login: "Log in", login_how: "A token is made on the machine: graderd token create NAME --right command", token: "Token", login_do: "Log in", login_no: "This token is not one of the machine's.", logout: "Log out",
    read_only: "looks on; may stop", may_command: "may command",
    no_picture: "no picture", picture_age: "picture {} s old", picture_old: "OLD PICTURE: {} s", mirror: "mirrored: left is your left",
    soil: "Soil before the blade", litres: "litres", left: "left", center: "center", right: "right", ahead: "ahead", carried: "carried",
    decision: "Decision", none_yet: "none yet", plan: "Blade from above", requested: "requested", limited: "limited", measured: "measured",
    front: "Blade from behind", height: "height", slope: "slope", tilt: "tilt",
    modes: "Mode", arm: "Arm", disarm: "Disarm", manual: "Manual", auto: "Automatic", reset: "Reset stop",
    lease: "Moving it now:", nobody: "nobody", for_more: "{} for {} s more",
    jog: "Move by hand", jog_how: "It moves while you hold. Let go, and it holds.", needs_manual: "in manual mode alone",
    rotate: "turn", "rotate+": "↺ left", "rotate-": "right ↻", "height+": "▲ up", "height-": "▼ down", "slope+": "left end up", "slope-": "right end up", "pitch+": "top forward", "pitch-": "top back", pitch: "tilt",
    presets: "Poses: hold until it is there", faults: "Faults", no_faults: "no faults", clears: "clears {}", readiness: "Ready to arm?", met: "met", unmet: "unmet", may_be: "not needed to arm",
    machine: "Machine", camera: "camera", tick: "control", vehicle: "drives", last_stop: "last stop", version: "version", simulated: "SIMULATED", none: "none", unknown_speed: "not told",
    plots_h: "The last ten minutes", plot_angle: "Angle: requested (thin) and measured, °", plot_soil: "Soil ahead (left, center, right), litres", plot_height: "Height, mm",
    arrived: "there", released: "holding", lost: "the connection was lost: it holds", lapsed: "it holds: press again", jogging: "moving",
    m_disarmed: "DISARMED", m_manual: "MANUAL", m_auto: "AUTOMATIC", m_stopped: "STOPPED", arming: "ARMING",
    z_left: "LEFT", z_center: "CENTER", z_right: "RIGHT", z_even: "EVEN", z_none: "NO SOIL", z_unknown: "NOT SURE",
    travel: "travel", other: "Language: Korean", stop: "STOP", stop_key: "The space bar stops as well.",
    alt_camera: "live picture of the soil before the blade", alt_profile: "height of the soil along the blade, from its left end to its right", alt_plan: "blade from above with requested, limited and measured angle", alt_front: "blade from behind with height, slope and tilt", alt_plot: "plot over the last ten minutes",
  },
  ko: {
    connecting: "연결 중 …", heard: "{}초 전 수신", live: "수신 중", never: "아직 수신 없음",
    work: "작업", move: "조작", health: "점검", plots: "그래프",
    login: "로그인", login_how: "토큰은 기계에서 만듭니다: graderd token create NAME --right command", token: "토큰", login_do: "로그인", login_no: "이 기계의 토큰이 아닙니다.", logout: "로그아웃",
    read_only: "보기 전용, 정지 가능", may_command: "조작 가능",
    no_picture: "영상 없음", picture_age: "영상 {}초 전", picture_old: "오래된 영상: {}초", mirror: "좌우 반전: 왼쪽이 운전자의 왼쪽",
    soil: "블레이드 앞의 흙", litres: "리터", left: "왼쪽", center: "가운데", right: "오른쪽", ahead: "전방", carried: "운반 중",
    decision: "판단", none_yet: "아직 없음", plan: "위에서 본 블레이드", requested: "요청", limited: "제한", measured: "측정",
    front: "뒤에서 본 블레이드", height: "높이", slope: "경사", tilt: "기울기",
    modes: "모드", arm: "작동 준비", disarm: "준비 해제", manual: "수동", auto: "자동", reset: "정지 해제",
    lease: "지금 조작하는 곳:", nobody: "없음", for_more: "{}, {}초 남음",
    jog: "손으로 조작", jog_how: "누르는 동안 움직입니다. 손을 떼면 멈춥니다.", needs_manual: "수동 모드에서만",
    rotate: "회전", "rotate+": "↺ 왼쪽", "rotate-": "오른쪽 ↻", "height+": "▲ 올림", "height-": "▼ 내림", "slope+": "왼쪽 올림", "slope-": "오른쪽 올림", "pitch+": "앞으로", "pitch-": "뒤로", pitch: "기울기",
    presets: "자세: 도달할 때까지 누르십시오", faults: "고장", no_faults: "고장 없음", clears: "해제: {}", readiness: "작동 준비 점검", met: "충족", unmet: "미충족", may_be: "없어도 작동 준비 가능",
    machine: "기계", camera: "카메라", tick: "제어", vehicle: "주행", last_stop: "마지막 정지", version: "버전", simulated: "모의 실험", none: "없음", unknown_speed: "알 수 없음",
    plots_h: "최근 10분", plot_angle: "각도: 요청(가는 선), 측정, °", plot_soil: "전방의 흙 (왼쪽, 가운데, 오른쪽), 리터", plot_height: "높이, mm",
    arrived: "도달", released: "정지 유지", lost: "연결 끊김: 정지 유지", lapsed: "정지 유지: 다시 누르십시오", jogging: "움직이는 중",
    m_disarmed: "해제됨", m_manual: "수동", m_auto: "자동", m_stopped: "정지됨", arming: "준비 중",
    z_left: "왼쪽", z_center: "가운데", z_right: "오른쪽", z_even: "고름", z_none: "흙 없음", z_unknown: "불확실",
    travel: "진행 방향", other: "언어: 영어", stop: "정지 STOP", stop_key: "스페이스 바로도 정지합니다.",
    alt_camera: "블레이드 앞 흙의 실시간 영상", alt_profile: "블레이드 왼쪽 끝에서 오른쪽 끝까지 흙의 높이", alt_plan: "위에서 본 블레이드의 요청, 제한, 측정 각도", alt_front: "뒤에서 본 블레이드의 높이, 경사, 기울기", alt_plot: "최근 10분 그래프",
  },
};

let language = "en";
const daemons = {};
const CATALOGUES = { ko: "/page/korean.json" };
const RETRY_MS = 3000;

export const t = (key, ...parts) => parts.reduce((text, part) => text.replace("{}", part), TEXTS[language][key] ?? key);
export const current = () => language;
/** What the daemon said, in the page's language as far as that is known; else in its English. */
export const theirs = (text) => daemons[language]?.in(text) ?? text;

/** Have the daemon's words in the page's language; `learnt()` once they are there. */
export async function learn(learnt) {
  const wanted = language;
  if (!CATALOGUES[wanted] || daemons[wanted]) return;
  const { ok, status, ...catalogue } = await ask("GET", CATALOGUES[wanted]);
  if (!ok) return setTimeout(() => learn(learnt), RETRY_MS);
  daemons[wanted] = new Words(catalogue);
  learnt();
}

export function speak(wanted) {
  language = TEXTS[wanted] ? wanted : "en";
  document.documentElement.lang = language;
  for (const element of document.querySelectorAll("[data-t]")) element.textContent = t(element.dataset.t);
  for (const [id, key] of Object.entries({ camera: "alt_camera", profile: "alt_profile", plan: "alt_plan", front: "alt_front", "plot-angle": "alt_plot", "plot-soil": "alt_plot", "plot-height": "alt_plot" }))
    document.getElementById(id).setAttribute("aria-label", t(key));
  const button = document.getElementById("language");
  button.textContent = language === "en" ? "한" : "EN";
  button.lang = language === "en" ? "ko" : "en";
  button.setAttribute("aria-label", language === "en" ? "한국어" : "English");
  document.getElementById("stop-key").textContent = t("stop_key");
  document.querySelector("#stop button").textContent = t("stop");
}
