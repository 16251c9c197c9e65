// SPDX-License-Identifier: Apache-2.0
/** The bar of controls at the bottom. */

import type { Player } from "../player.js";
import type { XrMode } from "../xr/session.js";
import { made, setText } from "./dom.js";
import { timeText } from "./format.js";
import { button, type IconName, icon, relabel } from "./icons.js";
import { RATES } from "./keyboard.js";
import { TimelineBar } from "./timelineBar.js";

/** Actions of buttons outside the player itself. */
export interface BarActions {
  toggle(panel: "cameras" | "settings" | "statistics" | "help", button: HTMLButtonElement): void;
  compare(): void;
  share(): void;
  screenshot(): void;
  fullscreen(): void;
  /** Enters a session of a headset, or leaves it. */
  toggleXr(mode: XrMode): void;
}

export class Bar {
  readonly root: HTMLElement;
  readonly timeline: TimelineBar;
  readonly compare: HTMLButtonElement;
  /** Hidden where the device has no such session. */
  readonly xr: Readonly<Record<XrMode, HTMLButtonElement>>;
  private readonly play: HTMLButtonElement;
  private readonly loop: HTMLButtonElement;
  private readonly time = made("div", { class: "time" });
  private readonly rate: HTMLSelectElement;
  private readonly edge: HTMLButtonElement;
  private readonly mute: HTMLButtonElement;
  private readonly volume = made("input", { type: "range", min: "0", max: "1", step: "0.05", class: "wide" });
  private hearing: string | undefined;
  private face: IconName = "play";

  constructor(
    private readonly player: Player,
    actions: BarActions,
  ) {
    const engine = () => player.engine;
    this.timeline = new TimelineBar((seconds) => engine()?.seek(seconds));
    this.play = button("play", "Play", () => player.toggle());
    this.loop = button("loop", "Loop", () => player.setLoop(!player.loop), "medium");
    this.compare = button("compare", "Compare with the camera's picture", () => actions.compare());
    const xr = (face: "vr" | "ar", mode: XrMode) => {
      const made_ = button(face, `Enter ${face.toUpperCase()}`, () => actions.toggleXr(mode));
      made_.setAttribute("aria-pressed", "false");
      return made_;
    };
    this.xr = { "immersive-vr": xr("vr", "immersive-vr"), "immersive-ar": xr("ar", "immersive-ar") };
    for (const hidden of [this.compare, ...Object.values(this.xr)]) hidden.hidden = true;
    this.rate = made("select", { "aria-label": "Speed", title: "Speed", class: "medium" });
    for (const rate of RATES) this.rate.append(made("option", { value: String(rate) }, `${rate}×`));
    this.rate.addEventListener("change", () => {
      player.playbackRate = Number(this.rate.value);
    });
    this.edge = made("button", { type: "button", class: "edge", hidden: true });
    this.edge.addEventListener("click", () => player.goToNewest());
    this.mute = button("sound", "Mute", () => player.toggleSound());
    this.volume.setAttribute("aria-label", "Volume");
    this.volume.addEventListener("input", () => {
      player.setVolume(Number(this.volume.value));
      player.setMuted(false);
    });
    const panel = (name: Parameters<BarActions["toggle"]>[0], face: IconName, label: string, extra: string) => {
      const made_ = button(face, label, () => actions.toggle(name, made_), extra);
      made_.setAttribute("aria-expanded", "false");
      return made_;
    };
    this.root = made(
      "div",
      { class: "bar glass", part: "controls", role: "group", "aria-label": "Player controls" },
      this.timeline.root,
      made(
        "div",
        { class: "row" },
        this.play,
        button("back", "Previous frame", () => engine()?.step(-1), "wide"),
        button("forward", "Next frame", () => engine()?.step(1), "wide"),
        this.time,
        this.edge,
        made("div", { class: "space" }),
        this.mute,
        this.volume,
        this.rate,
        this.loop,
        this.compare,
        made("slot", { name: "controls" }),
        panel("cameras", "cameras", "Cameras", "noembed"),
        panel("statistics", "chart", "Statistics", "noembed wide"),
        panel("settings", "settings", "Picture", "noembed"),
        button("photo", "Save a screenshot", () => actions.screenshot(), "noembed wide"),
        button("link", "Copy a link to this view and time", () => actions.share(), "noembed wide"),
        panel("help", "help", "Keys", "noembed wide"),
        ...Object.values(this.xr),
        button("full", "Full screen", () => actions.fullscreen()),
      ),
    );
    this.update();
  }

  /** Must be called with every picture; updates what has changed. */
  update(): void {
    const { engine } = this.player;
    this.timeline.update();
    this.loop.setAttribute("aria-pressed", String(this.player.loop));
    if (this.rate.value !== String(this.player.playbackRate)) this.rate.value = String(this.player.playbackRate);
    this.play.disabled = !engine?.header;
    const face: IconName = engine && !engine.paused ? "pause" : engine?.ended ? "again" : "play";
    if (face !== this.face) {
      this.face = face;
      const label = { play: "Play", pause: "Pause", again: "Play again" }[face as "play"];
      this.play.replaceChildren(icon(face));
      relabel(this.play, label);
    }
    this.updateSound();
    this.updateEdge();
    this.updateTime();
  }

  private updateSound(): void {
    const { sound, playbackRate } = this.player;
    this.mute.hidden = this.volume.hidden = !sound.present;
    if (!sound.present) return;
    const volume = String(sound.muted ? 0 : sound.volume);
    if (this.volume.value !== volume) this.volume.value = volume;
    const off = playbackRate === 1 ? "" : " (off at other speeds)";
    const label = sound.waits ? "Play the sound" : `${sound.muted ? "Unmute" : "Mute"}${off}`;
    if (label === this.hearing) return;
    this.hearing = label;
    this.mute.replaceChildren(icon(sound.muted || sound.waits || off ? "silent" : "sound"));
    relabel(this.mute, label);
  }

  private updateEdge(): void {
    const { engine } = this.player;
    const live = engine?.edge.live === true;
    this.edge.hidden = !engine?.edge.grows || (!live && engine.frameIndex >= engine.frames.count - 1);
    if (this.edge.hidden || !engine) return;
    const behind = Math.round(engine.behindSeconds);
    const distance = behind >= 60 ? timeText(behind, false) : `${behind} s`;
    setText(this.edge, live ? (behind ? `LIVE −${distance}` : "LIVE") : "Newest");
    this.edge.classList.toggle("at", engine.edge.following && !engine.paused);
    const title = behind ? `Go to the newest frames: ${distance} behind them` : "At the newest frame";
    if (this.edge.title === title) return;
    relabel(this.edge, title, live ? `Live. ${title}` : title);
  }

  private updateTime(): void {
    const { engine } = this.player;
    if (!engine?.frames.count) {
      setText(this.time, "");
      return;
    }
    const fine = engine.frames.duration < 60;
    const now = timeText(engine.currentTime, fine);
    const total = timeText(engine.frames.duration, fine);
    // The next button shows the distance to the edge of a live stream.
    const text = engine.edge.live ? now : `${now} / ${total}`;
    const frame = ` · frame ${engine.frameIndex}`;
    if (this.time.textContent === text + frame) return;
    this.time.replaceChildren(text, made("span", { class: "soft" }, frame));
  }
}
