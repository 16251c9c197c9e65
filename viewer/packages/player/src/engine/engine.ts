// SPDX-License-Identifier: Apache-2.0
/** Playback without a page: a clock, frames from a decoder, and the handling of late or missing ones. */

import type { StreamHeader } from "@structgstream/core";
import type { Demand, FromDecoder } from "../decode/messages.js";
import { SOUND_AHEAD_SECONDS, type Sound } from "../sound/sound.js";
import type { SourceDescription } from "../source/description.js";
import { demandOf } from "./ahead.js";
import { MediaClock } from "./clock.js";
import { Edge } from "./edge.js";
import { Emitter } from "./emitter.js";
import type { EngineEvents } from "./events.js";
import { type DueUpdate, FrameQueue } from "./frameQueue.js";
import { PacketLog } from "./packetLog.js";
import type { Pipeline } from "./pipeline.js";
import { Progress } from "./progress.js";
import { Rebuffering } from "./rebuffering.js";
import { StoredFrames } from "./storedFrames.js";
import { Timeline } from "./timeline.js";

const RATES: readonly [number, number] = [0.05, 16];

/**
 * The nearest rate that can be played.
 *
 * @throws RangeError it is not positive
 */
export function allowedRate(rate: number): number {
  if (!Number.isFinite(rate) || rate <= 0) {
    throw new RangeError(`The playback rate is ${rate}; expected a positive number, such as 0.5.`);
  }
  return Math.min(Math.max(rate, RATES[0]), RATES[1]);
}

export class Engine extends Emitter<EngineEvents> {
  loop = false;
  header: StreamHeader | undefined;
  private readonly clock = new MediaClock();
  private readonly queue = new FrameQueue();
  readonly frames = new Timeline();
  /** The end of the stream while it grows. */
  readonly edge = new Edge(this.frames);
  readonly packets = new PacketLog();
  /** Names of the renditions, none if there is only one, and the one in use. */
  qualities: { readonly names: readonly string[]; readonly at: number } = { names: [], at: 0 };
  /** The chosen rendition; undefined for automatic selection. */
  quality: number | undefined;
  private opened = false;
  private rate = 1;
  readonly stored = new StoredFrames(this.frames);
  private readonly waiting = new Rebuffering(this.frames, this.stored, this.edge);
  private startSeconds: number | undefined;
  private name = "The stream";
  private readonly progress = new Progress();
  private demanded: Demand | undefined;
  private wantsToPlay = false;
  private isStalled = false;
  private hasEnded = false;
  private failed = false;

  /**
   * @param now seconds of a monotonic clock
   * @param sound plays the stream's sound; its clock is `now`
   */
  constructor(
    private readonly pipeline: Pipeline,
    private readonly now: () => number,
    private readonly sound?: Sound,
  ) {
    super();
    pipeline.onmessage = (message) => this.hear(message);
  }

  /**
   * Opens a stream and shows its frame at `startSeconds`. The default is the first frame, or of a live stream the last key
   * frame that is far enough behind the newest. An engine opens only one stream.
   */
  load(source: SourceDescription, startSeconds?: number): void {
    this.startSeconds = startSeconds;
    this.name = source.name;
    this.pipeline.send({ type: "open", source, fromStart: (startSeconds ?? 0) <= 0 });
  }

  play(): void {
    if (this.failed || this.wantsToPlay) return;
    this.wantsToPlay = true;
    if (this.hasEnded) this.seekFrame(0);
    else if (this.opened && this.edge.following) this.goLive();
    else if (!this.seeking && this.frames.count) this.clock.start(this.now());
    this.emit("state", {});
  }

  pause(): void {
    if (!this.wantsToPlay) return;
    this.wantsToPlay = false;
    this.edge.follow = false;
    this.clock.stop(this.now());
    this.setStalled(false);
    this.emit("state", {});
  }

  /** Seeks to a time; the key frame before it and then its frame are drawn as soon as they arrive. */
  seek(seconds: number): void {
    const { frames: timeline } = this;
    if (!this.opened || !timeline.count) {
      this.startSeconds = seconds;
      return;
    }
    const time = Math.min(Math.max(seconds, timeline.start), timeline.duration);
    // A seek to the position of following, or later, starts following.
    this.edge.follow = time >= this.edge.seconds - this.edge.distance;
    this.begin(timeline.frameAt(time), time);
  }

  seekFrame(index: number): void {
    const { frames: timeline } = this;
    const frame = Math.min(Math.max(Math.round(index), timeline.first), Math.max(timeline.count - 1, 0));
    this.edge.follow = frame === timeline.count - 1;
    this.begin(frame, timeline.ptsOf(frame));
  }

  /** Seeks to the edge of a live stream and follows it. */
  goLive(playing = true): void {
    if (!this.edge.live) return;
    this.wantsToPlay = playing && !this.failed;
    this.edge.follow = true;
    this.begin(this.edge.start, this.frames.ptsOf(this.edge.start));
  }

  /** Seconds from the clock to the newest frame. */
  get behindSeconds(): number {
    return Math.max(this.edge.seconds - this.clock.at(this.now()), 0);
  }

  /** Chooses a rendition; undefined for automatic selection. */
  chooseQuality(quality: number | undefined): void {
    this.quality = quality;
    this.pipeline.send({ type: "quality", quality });
  }

  /** Pauses and steps forward or back by a number of frames. */
  step(frames: number): void {
    this.pause();
    this.seekFrame(this.frameIndex + frames);
  }

  get playbackRate(): number {
    return this.rate;
  }

  set playbackRate(rate: number) {
    this.rate = allowedRate(rate);
    this.clock.setRate(this.rate, this.now());
    this.emit("state", {});
  }

  get currentTime(): number {
    return Math.min(this.clock.at(this.now()), Math.max(this.frames.duration, 0));
  }

  /** The frame at the clock, or the target of a seek. */
  get frameIndex(): number {
    const { seeking, target } = this.progress;
    return seeking ? target : this.frames.frameAt(this.clock.at(this.now()));
  }

  get paused(): boolean {
    return !this.wantsToPlay;
  }

  get seeking(): boolean {
    return this.progress.seeking;
  }

  get stalled(): boolean {
    return this.isStalled;
  }

  get ended(): boolean {
    return this.hasEnded;
  }

  /** Seconds until the next frame of a growing stream; undefined if its pace is unknown. */
  get nextFrameSeconds(): number | undefined {
    return this.edge.nextIn(this.now());
  }

  /** Must be called before each picture: advances the clock and returns a new update to draw, if there is one. */
  tick(): DueUpdate | undefined {
    if (!this.opened || this.failed) return undefined;
    const now = this.now();
    if (this.wantsToPlay && !this.seeking) this.advance(now);
    // Sound at another speed than the viewer's pictures would not be right.
    const audible = this.clock.running && this.rate === 1;
    this.sound?.update({ audible, seconds: this.clock.at(now), rate: this.clock.rate, now });
    this.ask();
    const update = this.queue.take(this.frames.frameAt(this.clock.at(now)));
    if (!update) return undefined;
    this.progress.shown = update.index;
    this.emit("frame", { index: update.index, ptsSeconds: update.ptsSeconds });
    return update;
  }

  destroy(): void {
    this.failed = true;
    this.pipeline.onmessage = undefined;
    this.pipeline.close();
    this.sound?.begin(undefined);
    this.clear();
  }

  private begin(frame: number, seconds: number): void {
    const now = this.now();
    this.progress.seek(frame);
    this.hasEnded = false;
    this.clock.stop(now);
    this.clock.set(seconds, now);
    this.sound?.flush();
    this.queue.carryAll();
    this.ask();
    this.emit("state", {});
  }

  private advance(now: number): void {
    const { clock, frames: timeline, progress } = this;
    const pace = this.edge.pace(clock.at(now), this.rate);
    if (pace.to !== undefined) {
      if (pace.why) this.emit("notice", { message: pace.why });
      this.setStalled(false);
      if (pace.to > progress.reached) this.begin(pace.to, timeline.ptsOf(pace.to));
      else {
        // The decoder knows of frames earlier and has sent it already.
        clock.set(timeline.ptsOf(pace.to), now);
        clock.start(now);
      }
      return;
    }
    if (pace.rate !== clock.rate) clock.setRate(pace.rate, now);
    const time = clock.at(now);
    const ahead = this.demanded?.ahead ?? 1;
    if (this.isStalled && this.waiting.isOver(time, clock.rate, progress.reached, ahead, now)) {
      this.setStalled(false);
      clock.start(now);
    }
    if (!clock.running) return;
    const missing = this.missingAt(timeline.frameAt(time));
    if (missing !== undefined) {
      clock.stop(now);
      clock.set(Math.min(time, Math.max(timeline.endOf(Math.max(missing - 1, 0)) - 1e-3, 0)), now);
      this.setStalled(true);
    } else if (time >= timeline.duration) this.stopAtEnd(now);
  }

  /**
   * The frame that a clock at `frame` has to wait for, as it has not arrived; undefined if there is none.
   *
   * However late a picture is, the clock does not pass such a frame: the decoder sends no frames before those that were
   * demanded, so a clock that had to go back would wait for them for ever.
   */
  private missingAt(frame: number): number | undefined {
    const { progress, demanded } = this;
    if (frame <= progress.reached) return undefined;
    const missing = this.stored.missing(Math.max(progress.reached + 1, demanded?.at ?? 0));
    return missing <= frame ? missing : undefined;
  }

  private stopAtEnd(now: number): void {
    const { clock, frames: timeline } = this;
    if (timeline.complete && this.loop) {
      this.seekFrame(0);
      return;
    }
    clock.stop(now);
    if (!timeline.complete) {
      // The last frame is shown until the next one was written; a viewer at the edge follows it.
      this.edge.follow = true;
      clock.set(Math.max(timeline.duration - 1e-3, 0), now);
      this.setStalled(true);
      return;
    }
    clock.set(timeline.duration, now);
    this.hasEnded = true;
    this.wantsToPlay = false;
    this.emit("ended", {});
    this.emit("state", {});
  }

  /** Sends the demand to the decoder, if it has changed. */
  private ask(): void {
    const { frames: timeline, clock, frameIndex: at } = this;
    const { serial } = this.progress;
    const rate = this.wantsToPlay ? clock.rate : undefined;
    const { until, ahead } = demandOf(timeline, serial, at, rate);
    const sound = this.soundDemand(at);
    const last = this.demanded;
    const isSame = last?.serial === serial && last.at === at && last.until === until && last.ahead === ahead;
    if (isSame && last.sound?.serial === sound?.serial && last.sound?.until === sound?.until) return;
    this.demanded = { serial, at, until, ahead, sound };
    this.pipeline.send({ type: "demand", demand: this.demanded });
  }

  /** The sound to send for a clock at frame `at`. */
  private soundDemand(at: number): Demand["sound"] {
    const { frames: timeline, rate, sound } = this;
    if (!sound?.wanted || !this.wantsToPlay || rate !== 1) return undefined;
    return { serial: sound.serial, until: timeline.frameAt(timeline.ptsOf(at) + SOUND_AHEAD_SECONDS) + 1 };
  }

  private hear(message: FromDecoder): void {
    if (message.type === "frame") this.hearFrame(message);
    else if (message.type === "sound") this.sound?.take(message.serial, message.sounds);
    else if (message.type === "gap") this.hearGap(message.serial, message.end);
    else if (message.type === "opening") this.emit("opening", message);
    else if (message.type === "header") this.hearHeader(message.header, message.ranged);
    else if (message.type === "catalog") this.hearCatalog(message);
    else if (message.type === "stored") {
      this.stored.ranges = message.ranges;
      this.stored.fetchedBytes = message.fetchedBytes;
      this.tellProgress();
    } else if (message.type === "damage") this.emit("error", { message: message.message, fatal: false });
    else if (message.type === "waiting") this.hearWaiting(message.seconds, message.problem);
    else if (message.type === "notice") this.emit("notice", message);
    else if (message.type === "qualities") {
      this.qualities = message;
      this.emit("state", {});
    } else this.fail(message.message, message.fatal);
  }

  private hearHeader(header: StreamHeader, ranged: boolean): void {
    this.header = header;
    this.frames.fps = header.fps;
    this.sound?.begin(header.sound);
    this.emit("header", header);
    if (ranged) return;
    this.emit("notice", {
      message: "The server does not support range requests, so the whole file is fetched.",
    });
  }

  private hearCatalog({ facts }: FromDecoder & { type: "catalog" }): void {
    const { frames: timeline, edge } = this;
    const wasLive = edge.live;
    timeline.take(facts);
    edge.changed(this.now());
    if (wasLive && !edge.live) this.emit("notice", { message: "The stream has ended; it is a recording now." });
    if (!wasLive && edge.live && this.opened) {
      this.emit("notice", { message: "The stream continues." });
      if (this.hasEnded) this.goLive();
    }
    this.startIfThere();
    this.tellProgress();
    if (facts.complete && !timeline.count) this.fail(`${this.name} has a header and no whole frame to show.`, true);
  }

  private hearWaiting(seconds: number, problem: string | undefined): void {
    if (problem !== undefined) {
      this.emit("notice", { message: `${problem} The next attempt is in ${seconds} s.` });
      return;
    }
    this.edge.reached = true;
    this.startIfThere();
    this.tellProgress();
  }

  private startIfThere(): void {
    const { startSeconds, frames: timeline } = this;
    if (this.opened || !timeline.count) return;
    if ((startSeconds ?? 0) > timeline.duration && !timeline.complete && !this.edge.reached) return;
    this.opened = true;
    if (startSeconds === undefined && this.edge.live) this.goLive(this.wantsToPlay);
    else this.seek(startSeconds ?? timeline.start);
  }

  private hearFrame(message: FromDecoder & { type: "frame" }): void {
    const { serial, exact, packets, header } = message;
    const update = { ...message.update, header };
    this.packets.take(packets, message.decodeMilliseconds);
    const { progress, queue } = this;
    if (serial !== progress.serial || progress.isBack(update.index, exact)) {
      queue.carry(update);
      return;
    }
    queue.add(update, progress.seeking);
    progress.reach(update.index);
    if (exact && progress.seeking) this.arrive();
  }

  private hearGap(serial: number, end: number): void {
    if (serial !== this.progress.serial) return;
    this.progress.reach(end - 1);
    if (this.seeking) this.arrive();
  }

  private arrive(): void {
    this.progress.arrive();
    if (this.wantsToPlay) this.clock.start(this.now());
    this.emit("state", {});
  }

  private setStalled(stalled: boolean): void {
    if (this.isStalled === stalled) return;
    this.isStalled = stalled;
    if (stalled) this.edge.stalled();
    this.waiting.begin();
    this.emit("stall", { stalled });
  }

  private tellProgress(): void {
    this.emit("progress", {
      buffered: this.stored.times,
      fetchedBytes: this.stored.fetchedBytes,
      durationSeconds: this.frames.duration,
      complete: this.frames.complete,
    });
  }

  private fail(message: string, fatal: boolean): void {
    this.failed ||= fatal;
    this.pause();
    this.sound?.flush();
    this.demanded = undefined; // the next demand tries again
    this.emit("error", { message, fatal });
  }
}
