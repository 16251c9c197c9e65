// SPDX-License-Identifier: Apache-2.0
/** The timeline: the clock, the buffer, key frames and lost frames. */

import type { Engine } from "../engine/engine.js";
import { made, setText } from "./dom.js";
import { timeText } from "./format.js";

export class TimelineBar {
  readonly root: HTMLElement;
  private readonly canvas = made("canvas");
  private readonly tip = made("div", { class: "tip glass", hidden: true });
  private engine: Engine | undefined;
  private drawn = "";
  private version = 0;

  /** @param seek called with seconds, while scrubbing too */
  constructor(private readonly seek: (seconds: number) => void) {
    this.root = made(
      "div",
      { class: "timeline", part: "timeline", role: "slider", tabindex: "0", "aria-label": "Time" },
      this.canvas,
      this.tip,
    );
    this.root.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      this.root.setPointerCapture(event.pointerId);
      this.seek(this.secondsAt(event));
    });
    this.root.addEventListener("pointermove", (event) => {
      if (this.root.hasPointerCapture(event.pointerId)) this.seek(this.secondsAt(event));
      this.showTip(event);
    });
    this.root.addEventListener("pointerleave", () => {
      this.tip.hidden = true;
    });
  }

  attach(engine: Engine): void {
    this.engine = engine;
    this.changed();
  }

  /** Buffer, key frames or length have changed. */
  changed(): void {
    this.version++;
  }

  /** Draws the changes. */
  update(): void {
    const { engine, root } = this;
    if (!engine) return;
    const { clientWidth: width, clientHeight: height } = root;
    const seconds = engine.currentTime;
    const scale = devicePixelRatio;
    const { start } = engine.frames;
    const { duration } = engine.frames;
    const span = Math.max(duration - start, 1e-6);
    const at = Math.round((Math.max(seconds - start, 0) / span) * width * scale);
    const state = `${this.version},${at},${width},${height},${scale},${duration},${getComputedStyle(root).color}`;
    if (state === this.drawn || !width) return;
    this.drawn = state;
    root.setAttribute("aria-valuemin", start.toFixed(2));
    root.setAttribute("aria-valuemax", duration.toFixed(2));
    root.setAttribute("aria-valuenow", seconds.toFixed(2));
    root.setAttribute("aria-valuetext", `${timeText(seconds, true)} of ${timeText(duration, true)}`);
    this.draw(engine, width, height, scale, at / scale);
  }

  private draw(engine: Engine, width: number, height: number, scale: number, at: number): void {
    const { canvas } = this;
    if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
    if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
    const context = canvas.getContext("2d");
    if (!context) return;
    const style = getComputedStyle(this.root);
    const fill = (name: string, from: number, to: number, top: number, tall: number) => {
      context.fillStyle = style.getPropertyValue(name);
      context.fillRect(from, top, Math.max(to - from, 1), tall);
    };
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.clearRect(0, 0, width, height);
    const { frames } = engine;
    const span = Math.max(frames.duration - frames.start, 1e-6);
    const x = (seconds: number) => Math.min(Math.max((seconds - frames.start) / span, 0), 1) * width;
    const top = height / 2 - 2;
    fill("--rail", 0, width, top, 4);
    for (const [start, end] of engine.stored.times) fill("--buffer", x(start), x(end), top, 4);
    fill("--accent", 0, at, top, 4);
    for (const [first, end] of frames.lost) fill("--lost", x(frames.ptsOf(first)), x(frames.endOf(end - 1)), top, 4);
    // More key frames would not be distinguishable.
    if (frames.keys.length < width / 4)
      for (const key of frames.keys) fill("--key", x(frames.ptsOf(key)), 0, top + 6, 3);
    context.fillStyle = style.getPropertyValue("--accent");
    context.beginPath();
    context.arc(Math.min(Math.max(at, 6), width - 6), height / 2, 6, 0, 2 * Math.PI);
    context.fill();
  }

  private secondsAt(event: PointerEvent): number {
    const { left, width } = this.root.getBoundingClientRect();
    const share = Math.min(Math.max((event.clientX - left) / Math.max(width, 1), 0), 1);
    const from = this.engine?.frames.start ?? 0;
    return from + share * ((this.engine?.frames.duration ?? 0) - from);
  }

  private showTip(event: PointerEvent): void {
    if (!this.engine || event.pointerType === "touch") return;
    const seconds = this.secondsAt(event);
    const { left } = this.root.getBoundingClientRect();
    this.tip.hidden = false;
    this.tip.style.left = `${event.clientX - left}px`;
    setText(this.tip, `${timeText(seconds, true)} · frame ${this.engine.frames.frameAt(seconds)}`);
  }
}
