// SPDX-License-Identifier: Apache-2.0
/**
 * Plays the sound of a stream: decodes packets some time ahead, and schedules what they give at the times of the pictures.
 *
 * Browsers decode whole files, so packets are decoded in chunks, each with some packets before it whose sound is dropped:
 * a decoder that begins anywhere needs them.
 */

import { type FrameSound, PACKET_SAMPLES, SOUND_RATE, type SoundFormat } from "@structgstream/core";
import { AudioClock } from "./audioClock.js";
import { oggOf } from "./ogg.js";

const PACKET_SECONDS = PACKET_SAMPLES / SOUND_RATE;
const PREROLL_PACKETS = 8;
/** Packets of a chunk, if there is time. */
const CHUNK_PACKETS = 25;
/** With less decoded than this, what is there is decoded at once. */
const URGENT_SECONDS = 0.5;
/** Seconds for which packets are wanted in advance. */
export const SOUND_AHEAD_SECONDS = 2;
/** Difference of sound and pictures above which the sound is scheduled anew. */
const TOLERANCE_SECONDS = 0.012;
const FADE_SECONDS = 0.01;
/** Decoded sound that is kept behind the clock. */
const KEPT_SECONDS = 1;
/** Packets that do not follow the last ones within this are after a gap. */
const GAP_SECONDS = PACKET_SECONDS / 2;
/** From the beginning of a click or a key press to its end. */
const GESTURE_SECONDS = 0.5;
const GESTURES = ["pointerup", "keydown", "touchend"] as const;

/** Packets that follow each other and were not decoded yet; `before` are those before them. */
interface Run {
  seconds: number;
  packets: Uint8Array[];
  before: Uint8Array[];
}

/** Decoded sound: `length` seconds from `from` on in the buffer, to be heard from media time `seconds` on. */
interface Chunk {
  readonly seconds: number;
  readonly buffer: AudioBuffer;
  readonly from: number;
  readonly length: number;
}

/** What is scheduled: media time is `origin + rate * context time`. */
interface Schedule {
  readonly origin: number;
  readonly rate: number;
  readonly fade: GainNode;
  readonly sources: Map<Chunk, AudioBufferSourceNode>;
}

/** The state of the pictures. */
export interface Playing {
  /** Whether the clock runs, at the speed of the stream or a little faster to catch up. */
  readonly audible: boolean;
  /** Media time. */
  readonly seconds: number;
  readonly rate: number;
  /** Seconds of {@link Sound.now}. */
  readonly now: number;
}

export interface SoundOptions {
  /** @throws when the browser has no sound */
  readonly startContext: () => AudioContext;
  /** Seconds of a monotonic clock, that of `performance`. */
  readonly wall: () => number;
  /** Where gestures are heard that let a browser play sound; undefined outside a page. */
  readonly gestures?: Pick<EventTarget, "addEventListener" | "removeEventListener"> | undefined;
  /** Information for the user. */
  readonly notice: (message: string) => void;
}

export class Sound {
  private readonly clock: AudioClock;
  private context: AudioContext | undefined;
  private gain: GainNode | undefined;
  private format: SoundFormat | undefined;
  private broken = false;
  private isMuted = false;
  private level = 1;
  private runs: Run[] = [];
  private chunks: Chunk[] = [];
  private schedule: Schedule | undefined;
  private decoding = false;
  /** By how much later than the clock says pictures are seen, and so sound is to be heard. */
  lagSeconds = 0;
  /** Changes when what was there before must not be played any more. */
  serial = 0;
  private asked = false;
  /** When a gesture let the browser play sound. */
  private wokeAt = Number.NEGATIVE_INFINITY;

  constructor(private readonly options: SoundOptions) {
    this.clock = new AudioClock(options.wall);
  }

  /** Seconds of a monotonic clock: the sound card's while sound can be played. */
  readonly now = (): number => this.clock.now();

  get muted(): boolean {
    return this.isMuted;
  }

  set muted(muted: boolean) {
    this.isMuted = muted;
    if (muted) this.flush();
  }

  get volume(): number {
    return this.level;
  }

  set volume(volume: number) {
    this.level = volume;
    if (this.gain && this.context) this.gain.gain.setTargetAtTime(volume, this.context.currentTime, FADE_SECONDS);
  }

  /** Whether the stream has sound that can be played here. */
  get present(): boolean {
    return this.format !== undefined && !this.broken;
  }

  /** Whether packets are of use now. */
  get wanted(): boolean {
    return this.present && !this.isMuted && this.context?.state === "running";
  }

  /** Whether the browser waits for a gesture before it plays sound. */
  get waits(): boolean {
    return this.present && !this.isMuted && this.context !== undefined && this.context.state !== "running";
  }

  /** Whether a gesture has just let the browser play sound, and so is not about muting it. */
  get woke(): boolean {
    return this.options.wall() - this.wokeAt < GESTURE_SECONDS;
  }

  /** Another stream is opened, with this sound; undefined for none. */
  begin(format: SoundFormat | undefined): void {
    this.flush();
    this.broken = false;
    this.format = format?.codec === "opus" ? format : undefined;
    if (format && !this.format) {
      this.options.notice(`The stream's sound is of a kind that this player does not know (${format.codec}).`);
    }
  }

  /** Packets of frames in order, from before the clock on, as demanded with a `serial`. */
  take(serial: number, sounds: readonly FrameSound[]): void {
    if (serial !== this.serial) return;
    for (const { seconds, packets } of sounds) {
      if (!packets.length) continue;
      const last = this.runs.at(-1);
      const end = last && last.seconds + last.packets.length * PACKET_SECONDS;
      if (last && end !== undefined && Math.abs(seconds - end) < GAP_SECONDS) last.packets.push(...packets);
      else this.runs.push({ seconds, packets: [...packets], before: [] });
    }
  }

  /** Forgets all sound; called after a seek. */
  flush(): void {
    this.silence();
    this.serial++;
    this.runs = [];
    this.chunks = [];
  }

  /** Must be called with each picture. */
  update(playing: Playing): void {
    if (!playing.audible || !this.present || this.isMuted) {
      this.silence();
      return;
    }
    const context = this.started();
    if (context?.state !== "running") return;
    this.decodeNext(context, playing.seconds);
    this.play(context, playing);
  }

  /** Ends all sound and releases the device. */
  destroy(): void {
    this.flush();
    this.clock.follow(undefined);
    this.ignoreGestures();
    this.context?.close().catch(() => undefined);
    this.context = undefined;
    this.format = undefined;
  }

  /** The context; browsers that want a gesture first let it run after one. */
  private started(): AudioContext | undefined {
    if (this.context) return this.context;
    try {
      const context = this.options.startContext();
      this.gain = context.createGain();
      this.gain.gain.value = this.level;
      this.gain.connect(context.destination);
      this.context = context;
      this.clock.follow(context);
    } catch (error) {
      this.fail(`This browser cannot play sound (${error instanceof Error ? error.message : error}).`);
      return undefined;
    }
    // A telephone call, say, ends sound until the next gesture.
    this.context.onstatechange = () => {
      if (this.context && this.context.state !== "running") this.waitForGesture();
    };
    this.wake();
    if (this.context.state !== "running") this.waitForGesture();
    return this.context;
  }

  private readonly wake = (event?: unknown): void => {
    this.context?.resume().then(
      () => {
        this.ignoreGestures();
        if (event) this.wokeAt = this.options.wall();
      },
      () => undefined, // another gesture may do
    );
  };

  private waitForGesture(): void {
    for (const name of GESTURES) this.options.gestures?.addEventListener(name, this.wake, { capture: true });
    // A context that may run begins within a moment.
    setTimeout(() => {
      if (!this.waits || this.asked) return;
      this.asked = true;
      this.options.notice("The browser plays sound after a click or a key.");
    }, 300);
  }

  private ignoreGestures(): void {
    for (const name of GESTURES) this.options.gestures?.removeEventListener(name, this.wake, { capture: true });
  }

  private fail(message: string): void {
    this.broken = true;
    this.flush();
    this.options.notice(message);
  }

  /** Decodes the next packets, if there are enough of them, or they are needed soon. */
  private decodeNext(context: AudioContext, seconds: number): void {
    const run = this.runs[0];
    if (this.decoding || !run) return;
    const last = this.chunks.at(-1);
    const end = last ? last.seconds + last.length : Number.NEGATIVE_INFINITY;
    const whole = this.runs.length > 1 || run.packets.length >= CHUNK_PACKETS;
    if (!run.packets.length || (!whole && end - seconds > URGENT_SECONDS)) {
      if (this.runs.length > 1 && !run.packets.length) this.runs.shift();
      return;
    }
    const packets = run.packets.splice(0);
    const { seconds: start, before } = run;
    run.seconds += packets.length * PACKET_SECONDS;
    run.before = [...before, ...packets].slice(-PREROLL_PACKETS);
    const { serial } = this;
    this.decoding = true;
    context
      .decodeAudioData(oggOf([...before, ...packets], this.format!.channels).buffer)
      .then(
        (buffer) => {
          if (serial !== this.serial) return;
          // Decoders differ in what they leave out at the beginning, and agree on the end.
          const length = Math.min(packets.length * PACKET_SECONDS, buffer.duration);
          const from = buffer.duration - length;
          this.chunks.push({ seconds: start + packets.length * PACKET_SECONDS - length, buffer, from, length });
        },
        () => {
          if (serial === this.serial) this.fail("This browser cannot play the stream's sound, which is Opus.");
        },
      )
      .finally(() => {
        this.decoding = false;
      });
  }

  private play(context: AudioContext, { seconds: time, rate, now }: Playing): void {
    const heard = this.clock.contextTime(now);
    if (heard === undefined) return;
    const seconds = time - this.lagSeconds * rate;
    let { schedule } = this;
    if (schedule && Math.abs(schedule.origin + schedule.rate * heard - seconds) > TOLERANCE_SECONDS) {
      this.silence();
      schedule = undefined;
    }
    if (!schedule) {
      const fade = context.createGain();
      fade.gain.setValueAtTime(0, context.currentTime);
      fade.gain.linearRampToValueAtTime(1, context.currentTime + FADE_SECONDS);
      fade.connect(this.gain!);
      // Whole samples, so that chunks meet without a gap.
      const origin = Math.round((seconds - rate * heard) * context.sampleRate) / context.sampleRate;
      schedule = { origin, rate, fade, sources: new Map() };
      this.schedule = schedule;
    }
    this.chunks = this.chunks.filter((chunk) => chunk.seconds + chunk.length > seconds - KEPT_SECONDS);
    for (const chunk of this.chunks) this.start(context, chunk, schedule);
  }

  private start(context: AudioContext, chunk: Chunk, { origin, rate, fade, sources }: Schedule): void {
    if (sources.has(chunk)) return;
    const at = (chunk.seconds - origin) / rate;
    const late = Math.max(context.currentTime - at, 0);
    const passed = late * rate;
    if (passed >= chunk.length) return;
    const source = context.createBufferSource();
    source.buffer = chunk.buffer;
    source.playbackRate.value = rate;
    source.connect(fade);
    source.start(at + late, chunk.from + passed, chunk.length - passed);
    source.onended = () => {
      source.disconnect();
      sources.delete(chunk);
    };
    sources.set(chunk, source);
  }

  /** Ends what is heard, softly. */
  private silence(): void {
    const { schedule, context } = this;
    this.schedule = undefined;
    if (!schedule || !context) return;
    const { fade, sources } = schedule;
    const now = context.currentTime;
    fade.gain.cancelScheduledValues(now);
    fade.gain.setValueAtTime(1, now);
    fade.gain.linearRampToValueAtTime(0, now + FADE_SECONDS);
    for (const source of sources.values()) source.stop(now + FADE_SECONDS);
    setTimeout(() => fade.disconnect(), 100);
  }
}
