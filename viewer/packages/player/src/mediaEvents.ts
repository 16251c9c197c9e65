// SPDX-License-Identifier: Apache-2.0
/** The events and states of a `<video>`, from the events of a player (HTML Living Standard, 4.8.11 Media elements). */

import type { Player } from "./player.js";

type Empty = Readonly<Record<string, never>>;

/** As of a `<video>`; `ended`, `error` and `progress` are among the player's own events. */
export interface MediaEvents {
  /** A stream is being opened. */
  loadstart: Empty;
  durationchange: Empty;
  /** Duration, cameras and header are known. */
  loadedmetadata: Empty;
  /** The first picture is drawn. */
  loadeddata: Empty;
  canplay: Empty;
  /** `paused` has become false. */
  play: Empty;
  /** Frames follow each other, from now or again. */
  playing: Empty;
  pause: Empty;
  /** Playback waits for bytes. */
  waiting: Empty;
  seeking: Empty;
  /** The frame of the seek's time is drawn next. */
  seeked: Empty;
  /** The time has changed: at most four times a second, and after each seek. */
  timeupdate: Empty;
  ratechange: Empty;
  /** `muted` or `volume` has changed. */
  volumechange: Empty;
}

/** Values of `readyState`. */
export const HAVE = { nothing: 0, metadata: 1, currentData: 2, enoughData: 4 } as const;

const TIME_UPDATE_SECONDS = 0.25;

export class MediaState {
  /** The message of a fatal error. */
  error: string | undefined;
  private duration = Number.NaN;
  private drawn = false;
  private paused = true;
  private seeking = false;
  /** Whether frames follow each other. */
  running = false;
  private stalled = false;
  private rate = 1;
  private muted: boolean;
  private volume: number;
  private updatedAt = Number.NEGATIVE_INFINITY;

  /** @param now seconds of a monotonic clock */
  constructor(
    private readonly player: Player,
    private readonly now: () => number,
    private readonly emit: (name: keyof MediaEvents) => void,
  ) {
    this.muted = player.sound.muted;
    this.volume = player.sound.volume;
  }

  get readyState(): number {
    if (Number.isNaN(this.duration)) return HAVE.nothing;
    if (!this.drawn) return HAVE.metadata;
    return this.stalled || this.seeking ? HAVE.currentData : HAVE.enoughData;
  }

  /** A stream is being opened: all that was known of the last one is forgotten. */
  begin(): void {
    if (!this.paused) this.emit("pause");
    this.error = undefined;
    this.duration = Number.NaN;
    this.drawn = false;
    this.paused = true;
    this.seeking = false;
    this.running = false;
    this.stalled = false;
    this.emit("loadstart");
  }

  /** Takes each event of the player before the page gets it. */
  take(name: string, detail: unknown): void {
    if (name === "state" || name === "ended") this.compare();
    else if (name === "stall") this.takeStall((detail as { readonly stalled: boolean }).stalled);
    else if (name === "progress") this.takeDuration((detail as { readonly durationSeconds: number }).durationSeconds);
    else if (name === "frame") this.timeChanged();
    else if (name === "drawn" && !this.drawn) {
      this.drawn = true;
      this.emit("loadeddata");
      this.emit("canplay");
      this.compare();
    } else if (name === "error") {
      const { message, fatal } = detail as { readonly message: string; readonly fatal: boolean };
      if (fatal) this.error = message;
      this.compare();
    }
  }

  private takeDuration(seconds: number): void {
    if (seconds === this.duration || !(seconds > 0)) return;
    const known = !Number.isNaN(this.duration);
    this.duration = seconds;
    this.emit("durationchange");
    if (!known) this.emit("loadedmetadata");
  }

  private takeStall(stalled: boolean): void {
    this.stalled = stalled;
    if (stalled) this.emit("waiting");
    this.compare();
  }

  private timeChanged(force = false): void {
    const time = this.now();
    if (!force && time - this.updatedAt < TIME_UPDATE_SECONDS) return;
    this.updatedAt = time;
    this.emit("timeupdate");
  }

  private compare(): void {
    const { engine, playbackRate, sound } = this.player;
    const { rate, paused, seeking, running, muted, volume } = this;
    this.muted = sound.muted;
    this.volume = sound.volume;
    if (muted !== this.muted || volume !== this.volume) this.emit("volumechange");
    this.rate = playbackRate;
    this.paused = engine?.paused ?? true;
    this.seeking = engine?.seeking ?? false;
    this.running = this.drawn && !this.paused && !this.seeking && !this.stalled;
    if (rate !== this.rate) this.emit("ratechange");
    if (paused && !this.paused) this.emit("play");
    // The first frame of a stream is sought, too; to a page that is loading it.
    if (!seeking && this.seeking && this.drawn) this.emit("seeking");
    if (seeking && !this.seeking && this.drawn) {
      this.timeChanged(true);
      this.emit("seeked");
    }
    if (!running && this.running) this.emit("playing");
    if (!paused && this.paused) {
      this.timeChanged(true);
      this.emit("pause");
    }
  }
}

/** Intervals of time as `HTMLMediaElement.buffered` has them; also an iterable of `[start, end]`. */
export class Ranges {
  constructor(private readonly ranges: readonly (readonly [number, number])[]) {}

  get length(): number {
    return this.ranges.length;
  }

  /** @throws RangeError there is no such interval */
  start(index: number): number {
    return this.at(index)[0];
  }

  /** @throws RangeError there is no such interval */
  end(index: number): number {
    return this.at(index)[1];
  }

  [Symbol.iterator](): Iterator<readonly [number, number]> {
    return this.ranges[Symbol.iterator]();
  }

  private at(index: number): readonly [number, number] {
    const range = this.ranges[index];
    if (!range) throw new RangeError(`There is no interval ${index}; there are ${this.length}.`);
    return range;
  }
}
