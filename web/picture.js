// The live picture, one request after the other, as wide as the link carries; and how old it is.
import { t } from "./texts.js";

const EVERY_MS = 1000 / 15;
const WIDTHS_PX = [320, 480, 640, 960];
const SLOW_MS = 180, QUICK_MS = 90, OLD_MS = 500;

export class Picture {
  constructor() {
    this.canvas = document.getElementById("camera");
    this.figure = document.getElementById("picture");
    this.said = document.getElementById("picture-age");
    this.taken_ms = null;
    this.width = 2;
    this.quick_n = 0;
    this.wanted = false;
    this.running = false;
    setInterval(() => this.tell(), 100);
  }

  /** Whether somebody sees it: what nobody sees is not fetched. */
  want(wanted) {
    this.wanted = wanted;
    if (wanted && !this.running) this.run();
  }

  async run() {
    this.running = true;
    while (this.wanted) {
      const began_ms = performance.now();
      const shown = await this.next();
      const took_ms = performance.now() - began_ms;
      this.adapt(shown ? took_ms : SLOW_MS);
      await new Promise((done) => setTimeout(done, shown ? Math.max(0, EVERY_MS - took_ms) : 700));
    }
    this.running = false;
  }

  async next() {
    try {
      const asked_ms = performance.now();
      const answer = await fetch(`/v1/preview.jpg?labels=false&width_px=${WIDTHS_PX[this.width]}`, { cache: "no-store", signal: AbortSignal.timeout(4000) });
      if (!answer.ok) return false;
      const age_ms = 1000 * Number(answer.headers.get("Picture-Age-S"));
      const making_ms = Number(/dur=([\d.]+)/.exec(answer.headers.get("Server-Timing"))?.[1] ?? 0);
      const image = await createImageBitmap(await answer.blob());
      this.taken_ms = asked_ms + making_ms - age_ms;  // the rest of the wait lay on the way: as old as it can be
      if (this.canvas.width !== image.width) { this.canvas.width = image.width; this.canvas.height = image.height; }
      const draw = this.canvas.getContext("2d"), mirrored = document.getElementById("mirror").checked;
      draw.setTransform(mirrored ? -1 : 1, 0, 0, 1, mirrored ? image.width : 0, 0);
      draw.drawImage(image, 0, 0);
      this.label(draw, image.width, image.height, mirrored);
      image.close();
      return true;
    } catch { return false; }
  }

  /** LEFT and RIGHT are the operator's, whichever way the picture is shown. */
  label(draw, width, height, mirrored) {
    const size = Math.round(width / 22), leftward = mirrored === this.faces_back;
    draw.setTransform(1, 0, 0, 1, 0, 0);
    draw.font = `800 ${size}px system-ui, sans-serif`;
    draw.lineWidth = size / 4; draw.strokeStyle = "#000"; draw.fillStyle = "#fff"; draw.lineJoin = "round";
    for (const [text, align, x] of [[t(leftward ? "left" : "right"), "left", size / 2], [t(leftward ? "right" : "left"), "right", width - size / 2]]) {
      draw.textAlign = align;
      draw.strokeText(text, x, height - size / 2); draw.fillText(text, x, height - size / 2);
    }
  }

  adapt(took_ms) {
    this.quick_n = took_ms < QUICK_MS ? this.quick_n + 1 : 0;
    if (took_ms > SLOW_MS && this.width > 0) this.width -= 1;
    const most = WIDTHS_PX.findIndex((px) => px >= this.canvas.clientWidth * (devicePixelRatio || 1));
    if (this.quick_n > 20 && this.width < (most < 0 ? WIDTHS_PX.length - 1 : most)) { this.width += 1; this.quick_n = 0; }
  }

  tell() {
    const age_ms = this.taken_ms === null ? null : performance.now() - this.taken_ms, old = age_ms === null || age_ms > OLD_MS;
    this.figure.toggleAttribute("data-old", old);
    this.said.textContent = age_ms === null ? t("no_picture") : t(old ? "picture_old" : "picture_age", (age_ms / 1000).toFixed(old ? 1 : 2));
  }
}
