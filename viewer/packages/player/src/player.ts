// SPDX-License-Identifier: Apache-2.0
/** A stream on a canvas: engine, renderer and a moving camera, without a user interface. */

import type { StreamHeader } from "@structgstream/core";
import {
  type Camera,
  center,
  fitted,
  type RenderStats,
  type ResourceCounts,
  type SplatRenderer,
  type Views,
} from "@structgstream/gl";
import { Emitter } from "./engine/emitter.js";
import { Engine } from "./engine/engine.js";
import type { EngineEvents } from "./engine/events.js";
import type { Pipeline } from "./engine/pipeline.js";
import { Sound } from "./sound/sound.js";
import type { SourceDescription } from "./source/description.js";
import { Flight } from "./view/flight.js";
import { carried, type View, viewOf } from "./view/navigator.js";
import type { Pacing, QualityControl } from "./view/quality.js";
import { nearPlane, type Rig, type RigCamera, rigOf } from "./view/rig.js";

export interface PlayerEvents extends EngineEvents {
  /** The camera or the picture's size has changed. */
  view: { readonly view: View };
  /** The rig's cameras may have changed. */
  rig: { readonly rig: Rig };
  /** A picture was drawn. */
  drawn: { readonly stats: RenderStats };
}

/** What a headset asks for. */
export interface HeadsetViews extends Views {
  readonly quality: Pacing;
}

export interface PlayerOptions {
  readonly renderer: SplatRenderer;
  readonly quality: QualityControl;
  readonly startPipeline: () => Pipeline;
  /** Seconds of a monotonic clock. */
  readonly now: () => number;
  /** @throws when the browser has no sound */
  readonly startAudio: () => AudioContext;
}

/** Longest interval between consecutive pictures; after a longer one the page was hidden, or nothing changed. */
const PAUSE_SECONDS = 1;
/** A picture that takes longer was held up by something else. */
const MAX_DRAW_SECONDS = 0.1;
/** Frames over which the time of drawing is measured. */
const DRAWN = 9;
const FLIGHT_SECONDS = 0.9;

export class Player extends Emitter<PlayerEvents> {
  rig: Rig | undefined;
  view: View | undefined;
  /** The rig's camera whose view is shown, until the camera moves. */
  atCamera: RigCamera | undefined;
  /** Whether the user has moved the camera since the stream was opened. */
  touched = false;
  /** Whether flights take no time. */
  still = false;
  /** Pictures get the exposure of the camera whose view is shown, for a comparison with its own. */
  exposed = false;
  engine: Engine | undefined;
  stats: RenderStats | undefined;
  /** Statistics of the last call that drew something. */
  drawnStats: RenderStats | undefined;
  /** Smoothed time between the last pictures; undefined if they are not consecutive. */
  pictureSeconds: number | undefined;
  loop = false;
  /** The sound of all streams, one after the other; its clock is that of the pictures. */
  readonly sound: Sound;
  private rate = 1;
  private size: readonly [width: number, height: number] = [1, 1];
  private flight: Flight | undefined;
  private landing: RigCamera | undefined;
  private fittedTo: { readonly view: Camera; readonly width: number; readonly height: number } | undefined;
  private drawnCamera: Camera | undefined;
  private drawnAt: number | undefined;
  private drawnView: View | undefined;
  /** The first frame that the renderer has received and not drawn yet. */
  private given: { readonly index: number; readonly at: number } | undefined;
  private hasScene = false;
  private tickedAt: number | undefined;
  /** Smoothed time between ticks. */
  private tickSeconds = 0;
  /** Times from the last frames' ticks to those that drew them: they are sorted in between. */
  private readonly drawSeconds: number[] = [];

  constructor(private readonly options: PlayerOptions) {
    super();
    this.sound = new Sound({
      startContext: options.startAudio,
      wall: options.now,
      gestures: globalThis.document,
      notice: (message) => this.emit("notice", { message }),
    });
    options.renderer.onError = (error) => this.emit("error", { message: error.message, fatal: false });
  }

  /** Opens a stream and closes the last one. `view` is set once the rig is known. */
  load(source: SourceDescription, startSeconds?: number, view?: (rig: Rig) => View): Engine {
    this.engine?.destroy();
    const engine = new Engine(this.options.startPipeline(), this.sound.now, this.sound);
    this.engine = engine;
    this.rig = undefined;
    this.flight = undefined;
    this.hasScene = false;
    this.given = undefined;
    this.touched = false;
    engine.loop = this.loop;
    engine.playbackRate = this.rate;
    for (const name of ["opening", "frame", "stall", "error", "notice", "progress", "state", "ended"] as const) {
      engine.on(name, (event) => this.emit(name, event as never));
    }
    engine.on("header", (header) => this.begin(header, view));
    engine.load(source, startSeconds);
    return engine;
  }

  set playbackRate(rate: number) {
    if (this.engine) this.engine.playbackRate = rate;
    this.rate = this.engine?.playbackRate ?? rate;
  }

  get playbackRate(): number {
    return this.rate;
  }

  /** Toggles between playing and paused. */
  toggle(): void {
    if (this.engine?.paused) this.engine.play();
    else this.engine?.pause();
  }

  /** Seeks to the newest frame; follows the edge of a live stream. */
  goToNewest(): void {
    if (this.engine?.edge.live) this.engine.goLive();
    else this.engine?.seekFrame(Number.MAX_SAFE_INTEGER);
  }

  setLoop(loop: boolean): void {
    this.loop = loop;
    if (this.engine) this.engine.loop = loop;
    this.emit("state", {});
  }

  setMuted(muted: boolean): void {
    this.sound.muted = muted;
    this.emit("state", {});
  }

  /** Mutes or unmutes; where the browser waits for a gesture, this was one. */
  toggleSound(): void {
    if (!this.sound.waits && !this.sound.woke) this.setMuted(!this.sound.muted);
  }

  /** @param volume from 0 to 1 */
  setVolume(volume: number): void {
    this.sound.volume = volume;
    this.emit("state", {});
  }

  /** Sets the number of pixels of the canvas. */
  resize(width: number, height: number): void {
    this.size = [Math.max(Math.round(width), 1), Math.max(Math.round(height), 1)];
    if (this.view) this.emit("view", { view: this.view });
  }

  /** The camera of the picture: that of the view, with the size of the canvas. */
  get camera(): Camera | undefined {
    const { view, size, fittedTo } = this;
    if (!view) return undefined;
    const [width, height] = size;
    if (!fittedTo || fittedTo.view !== view.camera || fittedTo.width !== width || fittedTo.height !== height) {
      this.fittedTo = { view: view.camera, width, height };
      const near = this.rig ? nearPlane(this.rig, center(view.camera)) : view.camera.near;
      this.drawnCamera = { ...fitted(view.camera, width, height), near };
    }
    return this.drawnCamera;
  }

  /** Moves the camera for user input; ends a flight. */
  navigate(move: (view: View, rig: Rig) => View): void {
    if (!this.view || !this.rig) return;
    this.touched = true;
    this.flight = undefined;
    this.landing = undefined;
    this.atCamera = undefined;
    this.setView(move(this.view, this.rig));
  }

  /** Flies to a camera of the rig. */
  flyTo(camera: RigCamera, seconds = FLIGHT_SECONDS): void {
    if (!this.view || !this.rig) return;
    this.flyToView(viewOf(camera.camera, this.rig.focus), seconds);
    this.landing = camera;
    if (!this.flight) this.land();
  }

  flyToView(view: View, seconds = FLIGHT_SECONDS): void {
    if (!this.view || !this.rig) return;
    this.landing = undefined;
    this.atCamera = undefined;
    this.flight = undefined;
    if (this.still || seconds <= 0) this.setView(view);
    else this.flight = new Flight(this.view, view, this.rig.focus, this.options.now(), seconds);
  }

  get flying(): boolean {
    return this.flight !== undefined;
  }

  /**
   * Must be called for every picture that the browser shows.
   *
   * @param isSeen whether it is shown; that of a hidden page says nothing of the device's speed
   * @param views pictures of a headset, instead of that of the canvas
   */
  tick(isSeen = true, views?: HeadsetViews): void {
    const { renderer, now } = this.options;
    const quality = views?.quality ?? this.options.quality;
    const time = now();
    const since = time - (this.tickedAt ?? Number.NEGATIVE_INFINITY);
    this.tickedAt = isSeen ? time : undefined;
    if (isSeen && since < PAUSE_SECONDS) this.tickSeconds = 0.9 * this.tickSeconds + 0.1 * since;
    if (!isSeen) this.drawnAt = this.given = undefined;
    if (this.flight) {
      const { view, over } = this.flight.at(time);
      if (over) this.flight = undefined;
      this.setView(view);
      if (over) this.land();
    }
    try {
      const update = this.engine?.tick();
      if (update) {
        if (update.header) this.goOn(update.header);
        renderer.update(update);
        this.hasScene = true;
        if (isSeen) this.given ??= { index: update.index, at: time };
      }
      const { camera } = this;
      if (!camera || !this.hasScene) return;
      const { maxSplats, pixelScale } = quality.current;
      renderer.maxSplats = maxSplats;
      renderer.pixelScale = pixelScale;
      const cameraName = this.exposed ? this.atCamera?.name : undefined;
      this.stats = views
        ? renderer.renderViews(views)
        : renderer.render(camera, cameraName === undefined ? {} : { cameraName });
    } catch (error) {
      this.engine?.destroy();
      this.engine = undefined;
      this.emit("error", { message: error instanceof Error ? error.message : String(error), fatal: true });
      return;
    }
    if (this.stats.drawn) this.measure(time, this.stats, quality, views !== undefined);
  }

  /** Seconds since the displayed frame was captured; undefined if unknown. */
  get ageSeconds(): number | undefined {
    const filmed = this.engine?.frames.live?.filmedAtZero;
    const shown = this.drawnStats?.ptsSeconds;
    return filmed === undefined || shown === undefined ? undefined : Date.now() / 1000 - filmed - shown;
  }

  get resources(): ResourceCounts {
    return this.options.renderer.resources;
  }

  /** The present picture as PNG. */
  screenshot(): Promise<Blob> {
    return this.options.renderer.screenshot();
  }

  destroy(): void {
    this.engine?.destroy();
    this.engine = undefined;
    this.sound.destroy();
    this.options.renderer.destroy();
    this.clear();
  }

  private begin(header: StreamHeader, view: ((rig: Rig) => View) | undefined): void {
    const rig = rigOf(header);
    this.rig = rig;
    this.options.renderer.load(header);
    this.setView(view ? view(rig) : viewOf(rig.first.camera, rig.focus));
    this.atCamera = view ? undefined : rig.first;
    this.emit("header", header);
    this.emit("rig", { rig });
  }

  /** The following frames belong to another header; picture and view do not change. */
  private goOn(header: StreamHeader): void {
    const before = this.engine?.header;
    if (this.engine) this.engine.header = header;
    this.options.renderer.load(header, true);
    const [rig, old] = [rigOf(header), this.rig];
    const named = (camera: RigCamera | undefined) => rig.cameras.find(({ name }) => name === camera?.name);
    const [at, landing] = [named(this.atCamera), named(this.landing)];
    this.rig = rig;
    if (this.view && before && old) this.view = carried(this.view, before.similarity, header.similarity);
    this.flight = undefined;
    this.landing = undefined;
    if (landing ?? at) this.flyTo((landing ?? at)!, 0);
    else this.atCamera = undefined;
    this.emit("rig", { rig });
  }

  private land(): void {
    this.atCamera = this.landing;
    this.landing = undefined;
    if (this.view) this.emit("view", { view: this.view });
  }

  private setView(view: View): void {
    this.view = view;
    this.emit("view", { view });
  }

  private measure(time: number, stats: RenderStats, quality: Pacing, inHeadset: boolean): void {
    const since = this.drawnAt === undefined ? undefined : time - this.drawnAt;
    this.drawnAt = time;
    const following = since !== undefined && since < PAUSE_SECONDS;
    this.pictureSeconds = following ? 0.9 * (this.pictureSeconds ?? since) + 0.1 * since : undefined;
    // A stream of few frames per second is not a slow device. Pictures of a moving camera should follow each other at
    // the screen's rate, and a frame should be drawn soon after its arrival; sorting runs in another thread.
    // A headset's pictures should always follow each other at its rate.
    if (following && (inHeadset || this.view !== this.drawnView)) quality.picture(since, stats.splats);
    else if (!inHeadset && this.given && (stats.frameIndex ?? -1) >= this.given.index) {
      quality.picture(Math.max(time - this.given.at - stats.sortMilliseconds / 1000, 0), stats.splats);
    }
    if (this.given && (stats.frameIndex ?? -1) >= this.given.index) {
      this.drawSeconds.push(Math.min(time - this.given.at, MAX_DRAW_SECONDS));
      if (this.drawSeconds.length > DRAWN) this.drawSeconds.shift();
      const middle = [...this.drawSeconds].sort((a, b) => a - b)[this.drawSeconds.length >> 1]!;
      // A frame is due half a tick before its own on average, and seen half a tick after it was drawn.
      this.sound.lagSeconds = middle + this.tickSeconds;
      this.given = undefined;
    }
    this.drawnView = this.view;
    this.drawnStats = stats;
    this.emit("drawn", { stats });
  }
}
