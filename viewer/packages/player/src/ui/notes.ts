// SPDX-License-Identifier: Apache-2.0
/** Messages of the player: one short note at a time, and the content of the middle while there is no picture. */

import { made, setText } from "./dom.js";
import { button } from "./icons.js";

const NOTE_SECONDS = 6;

export class Notes {
  readonly root = made("div");
  private readonly note = made("div", { class: "note glass", part: "note", role: "status", hidden: true });
  private readonly text = made("span");
  private readonly middle = made("div", { class: "middle", part: "message" });
  private readonly spoken = made("div", { class: "quiet", role: "status", "aria-live": "polite" });
  private until = 0;
  private readonly later: string[] = [];
  private passing = false;

  constructor() {
    this.note.append(
      this.text,
      button("close", "Close", () => this.hide()),
    );
    this.root.append(this.middle, this.note, this.spoken);
  }

  /**
   * Shows `text` after the present note; "" removes all.
   *
   * @param bad it is an error: shown immediately, until it is closed or another one comes
   */
  say(text: string, now: number, bad = false): void {
    if (text === "") this.later.length = 0;
    else if (!bad && !this.note.hidden && !this.passing) {
      this.later.push(text);
      return;
    }
    this.passing = false;
    setText(this.text, text);
    this.note.classList.toggle("bad", bad);
    this.note.hidden = text === "";
    this.until = bad ? Number.POSITIVE_INFINITY : now + NOTE_SECONDS;
  }

  /** Shows a state for a second; any other note replaces it. */
  status(text: string, now: number): void {
    if (!this.note.hidden && !this.passing) return;
    this.passing = true;
    this.say(text, now - NOTE_SECONDS + 1);
    this.passing = true;
  }

  tick(now: number): void {
    if (!this.note.hidden && now > this.until) this.hide();
    const next = this.note.hidden && this.later.shift();
    if (next) this.say(next, now);
  }

  /** A line for screen readers only. */
  speak(text: string): void {
    setText(this.spoken, text);
  }

  /** Shows why nothing can be played. */
  fail(text: string): void {
    this.hide();
    this.middle.classList.add("bad");
    this.middle.replaceChildren(made("p", { role: "alert" }, text));
  }

  /** The stream is being opened. */
  loading(loadedBytes: number, totalBytes: number | undefined, text: string): void {
    const known = totalBytes !== undefined && totalBytes > 0;
    const bar = this.middle.querySelector("progress");
    if (bar && this.middle.dataset.is === "loading") {
      if (known) bar.value = loadedBytes / totalBytes;
      setText(this.middle.querySelector("p")!, text);
      return;
    }
    const made_ = made("progress", { "aria-label": "Opening the stream", max: "1" });
    if (known) made_.value = loadedBytes / totalBytes;
    this.middle.classList.remove("bad");
    this.middle.dataset.is = "loading";
    this.middle.replaceChildren(made_, made("p", { class: "soft" }, text));
  }

  /** Shows other content in the middle, or none. */
  show(...children: Node[]): void {
    this.middle.classList.remove("bad");
    this.middle.dataset.is = "";
    this.middle.replaceChildren(...children);
  }

  private hide(): void {
    this.note.hidden = true;
  }
}
