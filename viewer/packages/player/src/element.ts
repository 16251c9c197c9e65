// SPDX-License-Identifier: Apache-2.0
/**
 * `<structgstream-player src="stream.sgs">`
 *
 * Attributes, members and events: docs/player.md. Events do not bubble, and `detail` has their data.
 */

import { SOUND_RATE } from "@structgstream/core";
import { type Camera, type RenderStats, type ResourceCounts, SplatRenderer } from "@structgstream/gl";
import { allowedRate, type Engine } from "./engine/engine.js";
import { type MediaEvents, MediaState, Ranges } from "./mediaEvents.js";
import { startedPipeline } from "./pipeline.js";
import { Player, type PlayerEvents } from "./player.js";
import { startedWorker } from "./scripts.js";
import type { SourceDescription } from "./source/description.js";
import { made } from "./ui/dom.js";
import { PlayerUi } from "./ui/playerUi.js";
import { STYLES } from "./ui/styles.js";
import { type Link, linkOf, viewFrom } from "./view/link.js";
import { viewOf } from "./view/navigator.js";
import { QualityControl } from "./view/quality.js";
import { offersXr, XR_MODES, type XrMode, XrSession } from "./xr/session.js";

/** As `MediaError.code` has it: the stream cannot be fetched or decoded. */
const MEDIA_ERR_SRC_NOT_SUPPORTED = 4;
/** In a page that is hidden the player goes on at this interval. */
const HIDDEN_MILLISECONDS = 500;
const NOTHING_WANTED = { playing: false, seconds: undefined };

interface Running {
  readonly player: Player;
  readonly canvas: HTMLCanvasElement;
  readonly quality: QualityControl;
  readonly ui: PlayerUi;
  readonly media: MediaState;
  readonly observer: ResizeObserver;
}

/** All events of the element, and their data. */
export interface ElementEvents extends PlayerEvents, MediaEvents {
  /** A session of a headset has begun, or ended: then `mode` is undefined. */
  xr: { readonly mode: XrMode | undefined };
}

export class StructgstreamPlayer extends HTMLElement {
  static readonly observedAttributes = ["src", "loop", "controls", "embed", "poster"];
  private running: Running | undefined;
  private ticking: number | undefined;
  private listening: ReturnType<typeof setInterval> | undefined;
  private link: Link | undefined;
  /** The stream's address, if a link can contain it. */
  private linked: string | undefined;
  private source = "";
  /** Whether it is muted; undefined: as the attribute says. */
  private silenced: boolean | undefined;
  private loudness = 1;
  private speed = 1;
  /** What was asked for before a stream was opened: to play, and from where. */
  private wanted: { readonly playing: boolean; readonly seconds: number | undefined } = NOTHING_WANTED;
  private session: XrSession | undefined;
  /** Pixels of the screen in one of the page when the picture got its size; the page's zoom changes it. */
  private pixelRatio = 0;

  constructor() {
    super();
    // What a page has set before this module ran hides the property of that name.
    for (const [name, value] of Object.entries(this)) {
      if (!Object.getOwnPropertyDescriptor(StructgstreamPlayer.prototype, name)?.set) continue;
      Reflect.deleteProperty(this, name);
      try {
        Reflect.set(this, name, value);
      } catch (error) {
        reportError(error);
      }
    }
  }

  connectedCallback(): void {
    this.link ??= this.hasAttribute("isolated") ? undefined : linkOf(new URL(location.href));
    if (!this.running) this.start();
    if (!this.running) return;
    if (!this.session) this.ticking ??= requestAnimationFrame(this.tick);
    this.listening ??= setInterval(this.listen, HIDDEN_MILLISECONDS);
  }

  disconnectedCallback(): void {
    // An element that is moved is connected again before this runs.
    queueMicrotask(() => {
      if (!this.isConnected) this.stop();
    });
  }

  attributeChangedCallback(name: string, before: string | null, after: string | null): void {
    if (!this.running || before === after) return;
    if (name === "src") this.openAttribute();
    else if (name === "loop") this.running.player.setLoop(after !== null);
    else this.applyAttributes(this.running.ui);
  }

  /** Opens a stream: an address, a file, or bytes. */
  load(source: string | Blob, seconds?: number): void {
    if (typeof source === "string") this.open(this.described(source), seconds);
    else this.open({ kind: "blob", blob: source, name: source instanceof File ? source.name : "The stream" }, seconds);
  }

  /** Plays; resolves when frames follow each other, and rejects as a video does if it is paused before or fails. */
  play(): Promise<void> {
    const { engine } = this;
    engine?.play();
    if (!engine) this.wanted = { ...this.wanted, playing: true };
    if (this.running?.media.running) return Promise.resolve();
    const started = new Promise<void>((resolve, reject) => {
      const waiting = new AbortController();
      const once = (name: string, settle: () => void) => {
        const heard = () => {
          waiting.abort();
          settle();
        };
        this.addEventListener(name, heard, { signal: waiting.signal });
      };
      const interrupted = () =>
        reject(new DOMException(this.error?.message ?? "Paused before it played.", "AbortError"));
      once("playing", resolve);
      once("pause", interrupted);
      if (engine) once("loadstart", interrupted);
    });
    started.catch(() => undefined); // who does not wait for it hears of an error by its event
    return started;
  }

  pause(): void {
    this.engine?.pause();
    this.wanted = { ...this.wanted, playing: false };
  }

  seek(seconds: number): void {
    if (this.engine) this.engine.seek(seconds);
    else this.wanted = { ...this.wanted, seconds };
  }

  /** Pauses and steps forward or back by a number of frames. */
  step(frames: number): void {
    this.engine?.step(frames);
  }

  get playbackRate(): number {
    return this.running?.player.playbackRate ?? this.speed;
  }

  /** @throws RangeError it is not positive */
  set playbackRate(rate: number) {
    this.speed = allowedRate(rate);
    if (this.running) this.running.player.playbackRate = rate;
  }

  get loop(): boolean {
    return this.running?.player.loop ?? this.hasAttribute("loop");
  }

  set loop(loop: boolean) {
    this.toggleAttribute("loop", loop);
    this.running?.player.setLoop(loop);
  }

  get muted(): boolean {
    return this.running?.player.sound.muted ?? this.silenced ?? this.defaultMuted;
  }

  set muted(muted: boolean) {
    this.silenced = muted;
    this.running?.player.setMuted(muted);
  }

  /** Whether it begins muted: the attribute, as of a video. */
  get defaultMuted(): boolean {
    return this.hasAttribute("muted");
  }

  set defaultMuted(muted: boolean) {
    this.toggleAttribute("muted", muted);
  }

  get volume(): number {
    return this.running?.player.sound.volume ?? this.loudness;
  }

  /** @throws DOMException it is not from 0 to 1 */
  set volume(volume: number) {
    if (!(volume >= 0 && volume <= 1)) {
      throw new DOMException(`The volume is ${volume}; expected a number from 0 to 1.`, "IndexSizeError");
    }
    this.loudness = volume;
    this.running?.player.setVolume(volume);
  }

  get currentTime(): number {
    return this.engine?.currentTime ?? 0;
  }

  set currentTime(seconds: number) {
    this.seek(seconds);
  }

  get duration(): number {
    return this.engine?.frames.duration ?? Number.NaN;
  }

  /** Seeks to the edge of a live stream and follows it. */
  goLive(): void {
    this.engine?.goLive();
  }

  /** Whether further frames of a segmented stream will come. */
  get live(): boolean {
    return this.engine?.edge.live ?? false;
  }

  /** Seconds to the newest frame of a stream that grows. */
  get behindSeconds(): number {
    return this.engine?.behindSeconds ?? 0;
  }

  /** Seconds since the displayed frame was captured, by the clocks of this machine and the trainer; NaN if unknown. */
  get ageSeconds(): number {
    return this.running?.player.ageSeconds ?? Number.NaN;
  }

  get paused(): boolean {
    return this.engine?.paused ?? !this.wanted.playing;
  }

  get ended(): boolean {
    return this.engine?.ended ?? false;
  }

  get seeking(): boolean {
    return this.engine?.seeking ?? false;
  }

  /** 0 nothing, 1 metadata, 2 the present frame, 4 enough to play, as of a video. */
  get readyState(): number {
    return this.running?.media.readyState ?? 0;
  }

  /** Why nothing can be played; null without a fatal error. */
  get error(): { readonly code: number; readonly message: string } | null {
    const message = this.running?.media.error;
    return message === undefined ? null : { code: MEDIA_ERR_SRC_NOT_SUPPORTED, message };
  }

  get buffered(): Ranges {
    return new Ranges(this.engine?.stored.times ?? []);
  }

  get seekable(): Ranges {
    const frames = this.engine?.frames;
    return new Ranges(frames?.count ? [[frames.start, frames.duration]] : []);
  }

  /** The address of the stream that is open; "" for a file or bytes. */
  get currentSrc(): string {
    return this.source;
  }

  get src(): string {
    return this.getAttribute("src") ?? "";
  }

  set src(address: string) {
    this.setAttribute("src", address);
  }

  get poster(): string {
    return this.getAttribute("poster") ?? "";
  }

  set poster(address: string) {
    this.setAttribute("poster", address);
  }

  get autoplay(): boolean {
    return this.hasAttribute("autoplay");
  }

  set autoplay(autoplay: boolean) {
    this.toggleAttribute("autoplay", autoplay);
  }

  get controls(): boolean {
    return this.getAttribute("controls") !== "off";
  }

  set controls(shown: boolean) {
    this.setAttribute("controls", shown ? "" : "off");
  }

  /** The camera of the picture, in scene units; setting it takes effect without a flight. */
  get camera(): Camera | undefined {
    return this.running?.player.camera;
  }

  set camera(camera: Camera | undefined) {
    const player = this.running?.player;
    if (camera && player?.rig) player.flyToView(viewOf(camera, player.rig.focus), 0);
  }

  /** Names of the rig's cameras. */
  get cameras(): readonly string[] {
    return this.running?.player.rig?.cameras.map(({ name }) => name) ?? [];
  }

  /** Flies to a camera of the rig in the given number of seconds. */
  show(camera: string, seconds = 0): void {
    const found = this.running?.player.rig?.cameras.find(({ name }) => name === camera);
    if (!found)
      throw new RangeError(`The stream has no camera ${camera}; it has ${this.cameras.join(", ") || "none"}.`);
    this.running!.player.flyTo(found, seconds);
  }

  /** The kind of the running WebXR session; undefined without one. */
  get xr(): XrMode | undefined {
    return this.session?.mode;
  }

  /**
   * Shows the stream in a headset; needs a click. Rejects with a sentence if there is no WebXR, or the session is refused.
   *
   * @throws Error also for a `metres` that is no positive number
   */
  async enterXr(mode: XrMode = "immersive-vr"): Promise<void> {
    const { running, session } = this;
    if (session) throw new Error(`The player is in ${session.mode} already; call exitXr() first.`);
    if (!running) throw new Error("There is nothing to show: the player is not in a page, or has no WebGL2.");
    const text = this.getAttribute("metres");
    const metres = text === null ? undefined : Number(text);
    if (metres !== undefined && !(metres > 0 && metres < Number.POSITIVE_INFINITY)) {
      throw new Error(`The attribute metres is ${JSON.stringify(text)}; expected the metres per unit of the capture.`);
    }
    const { player, canvas, quality } = running;
    const started = await XrSession.start(mode, { player, canvas, quality, metres, onEnd: () => this.leftXr(started) });
    // The headset's pictures drive the player now.
    this.stopTicking();
    this.session = started;
    if (this.running !== running) await started.end();
    else this.xrChanged();
  }

  /** Ends the session of the headset, if there is one. */
  async exitXr(): Promise<void> {
    await this.session?.end();
  }

  /** Statistics of the last picture. */
  get stats(): RenderStats | undefined {
    return this.running?.player.stats;
  }

  /** Decoding time per packet in the worker, for the packets of the last frame. */
  get decodeMilliseconds(): number {
    return this.engine?.packets.decodeMilliseconds ?? 0;
  }

  /** Memory of the renderer. */
  get resources(): ResourceCounts | undefined {
    return this.running?.player.resources;
  }

  /** Adds a listener and returns a function that removes it. Listeners remain when another stream is loaded. */
  on<EventName extends keyof ElementEvents>(
    name: EventName,
    listener: (event: ElementEvents[EventName]) => void,
  ): () => void {
    const heard = (event: Event) => listener((event as CustomEvent<ElementEvents[EventName]>).detail);
    this.addEventListener(name, heard);
    return () => this.removeEventListener(name, heard);
  }

  /** The present picture as PNG. */
  async screenshot(): Promise<Blob> {
    if (!this.running) throw new Error("There is no picture: the player is not in a page, or was destroyed.");
    return this.running.player.screenshot();
  }

  /** Terminates workers and releases all memory. The element can be inserted into a page again. */
  destroy(): void {
    this.stop();
    this.remove();
  }

  private get engine(): Engine | undefined {
    return this.running?.player.engine;
  }

  private start(): void {
    const root = this.shadowRoot ?? this.attachShadow({ mode: "open", delegatesFocus: true });
    const style = made("style", {}, STYLES);
    const canvas = made("canvas");
    const quality = new QualityControl(deviceOf(navigator));
    let player: Player;
    try {
      player = new Player({
        renderer: new SplatRenderer(canvas, { sorter: startedWorker("sort") }),
        quality,
        startPipeline: startedPipeline,
        now: () => performance.now() / 1000,
        startAudio: () => new AudioContext({ sampleRate: SOUND_RATE }),
      });
    } catch (error) {
      this.startWithout(root, style, error);
      return;
    }
    player.sound.muted = this.silenced ?? this.defaultMuted;
    player.sound.volume = this.loudness;
    player.playbackRate = this.speed;
    const ui = new PlayerUi({
      host: this,
      canvas,
      player,
      quality,
      open: (source) => this.open(source),
      saveScreenshot: () => void this.save(),
      toggleXr: (mode) => void this.toggleXr(mode),
      linkedSource: () => this.linked,
    });
    root.replaceChildren(style, ui.root);
    const observer = new ResizeObserver(() => this.resized());
    observer.observe(this);
    const media = new MediaState(
      player,
      () => performance.now() / 1000,
      (name) => this.dispatch(name, {}),
    );
    this.running = { player, canvas, quality, ui, media, observer };
    navigator.xr?.addEventListener("devicechange", this.offerXr);
    this.offerXr();
    player.relay = (name, detail) => {
      media.take(name, detail);
      this.dispatch(name, detail);
    };
    player.still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    player.setLoop(this.hasAttribute("loop"));
    this.applyAttributes(ui);
    this.resized();
    const refused = this.link?.refused ?? [];
    this.openAttribute();
    for (const sentence of refused) ui.say(sentence);
    const truth = this.getAttribute("truth");
    if (truth !== null) ui.compare.attach(new URL(truth, document.baseURI)).catch(() => undefined);
  }

  /** Shows that there is no WebGL2. */
  private startWithout(root: ShadowRoot, style: Node, error: unknown): void {
    const message = error instanceof Error ? error.message : String(error);
    root.replaceChildren(style, made("div", { class: "middle bad" }, made("p", { role: "alert" }, message)));
    this.dispatch("error", { message, fatal: true });
  }

  private readonly dispatch = (name: string, detail: unknown): void => {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  };

  private stop(): void {
    this.stopTicking();
    clearInterval(this.listening);
    this.listening = undefined;
    navigator.xr?.removeEventListener("devicechange", this.offerXr);
    void this.exitXr();
    const { running } = this;
    this.speed = this.playbackRate;
    this.running = undefined;
    running?.observer.disconnect();
    running?.player.destroy();
    this.shadowRoot?.replaceChildren();
  }

  private stopTicking(): void {
    if (this.ticking !== undefined) cancelAnimationFrame(this.ticking);
    this.ticking = undefined;
  }

  private readonly offerXr = (): void => {
    for (const mode of XR_MODES) void offersXr(mode).then((offered) => this.running?.ui.offerXr(mode, offered));
  };

  private async toggleXr(mode: XrMode): Promise<void> {
    try {
      await (this.xr ? this.exitXr() : this.enterXr(mode));
    } catch (error) {
      this.running?.ui.say(error instanceof Error ? error.message : String(error), true);
    }
  }

  private leftXr(ended: XrSession): void {
    if (this.session !== ended) return;
    this.session = undefined;
    if (!this.running) return;
    this.ticking ??= requestAnimationFrame(this.tick);
    this.xrChanged();
  }

  private xrChanged(): void {
    if (this.running) this.running.ui.xr = this.xr;
    this.dispatch("xr", { mode: this.xr });
  }

  private readonly tick = (): void => {
    this.ticking = requestAnimationFrame(this.tick);
    if (this.pixelRatio !== devicePixelRatio) this.resized();
    this.running?.player.tick();
    this.running?.ui.tick();
  };

  /** No pictures are asked for in a page or headset that is hidden; its sound goes on, as that of a video. */
  private readonly listen = (): void => {
    const { running, session } = this;
    if (session) running?.ui.tick(); // the page may be seen next to the headset
    if ((session?.hidden ?? document.hidden) && running?.player.sound.wanted) running.player.tick(false);
  };

  private applyAttributes(ui: PlayerUi): void {
    ui.controls = this.controls;
    ui.embed = this.hasAttribute("embed") || this.link?.embed === true;
    ui.poster = this.poster === "" ? undefined : new URL(this.poster, document.baseURI).href;
  }

  private openAttribute(): void {
    const linked = this.link?.src;
    const own = this.getAttribute("src");
    // A link can only name a stream of its own origin; redirects to other origins are refused.
    if (linked !== undefined) this.open(this.sourceAt(new URL(linked), true));
    else if (own !== null) this.open(this.described(own));
    else this.running?.ui.invite();
  }

  private described(source: string): SourceDescription {
    if (source.startsWith("#")) {
      const text = document.getElementById(source.slice(1))?.textContent;
      return { kind: "base64", text: text ?? "", name: "The page's stream" };
    }
    return this.sourceAt(new URL(source, document.baseURI), false);
  }

  /** A manifest, or a list of several, is JSON; everything else is a stream's file. */
  private sourceAt(url: URL, sameOrigin: boolean): SourceDescription {
    const own = url.origin === location.origin;
    const token = this.token();
    // The page's token also opens its streams; it is not sent to other hosts.
    if (own && token !== null && !url.searchParams.has("token")) url.searchParams.set("token", token);
    const found = { url: url.href, name: nameOf(url), sameOrigin };
    return url.pathname.endsWith(".json") ? { kind: "segments", own, ...found } : { kind: "url", ...found };
  }

  /** The access token in the page's address. */
  private token(): string | null {
    return this.hasAttribute("isolated") ? null : new URLSearchParams(location.search).get("token");
  }

  /** The address of a stream for a link, without the page's own token, which the link contains anyway. */
  private linkable(source: SourceDescription): string | undefined {
    if (!("url" in source)) return undefined;
    const url = new URL(source.url);
    if (url.origin !== location.origin) return undefined;
    if (url.searchParams.get("token") === this.token()) url.searchParams.delete("token");
    return url.href;
  }

  private open(source: SourceDescription, seconds?: number): void {
    const { running, link, wanted } = this;
    if (!running) return;
    const { player, ui, media } = running;
    const at = seconds ?? wanted.seconds ?? link?.seconds;
    this.wanted = NOTHING_WANTED;
    const view = link?.view;
    this.link = undefined; // a link applies only to the first stream
    this.linked = this.linkable(source);
    this.source = "url" in source ? source.url : "";
    media.begin();
    const engine = player.load(source, at, view && ((rig) => viewFrom(view, rig.first.camera)));
    ui.begin(source.name);
    if (wanted.playing || this.hasAttribute("autoplay")) engine.play();
  }

  private resized(): void {
    if (!this.running) return;
    this.pixelRatio = devicePixelRatio;
    const { width, height } = this.getBoundingClientRect();
    this.running.player.resize(width * devicePixelRatio, height * devicePixelRatio);
    this.running.ui.resize(width);
  }

  private async save(): Promise<void> {
    try {
      const url = URL.createObjectURL(await this.screenshot());
      made("a", { href: url, download: `frame-${this.running?.player.stats?.frameIndex ?? 0}.png` }).click();
      setTimeout(() => URL.revokeObjectURL(url), 10_000);
    } catch (error) {
      this.running?.ui.say(error instanceof Error ? error.message : String(error), true);
    }
  }
}

function nameOf(url: URL): string {
  const name = url.pathname.split("/").at(-1) || "The stream";
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

function deviceOf(browser: Navigator & { readonly deviceMemory?: number }) {
  return {
    coarsePointer: matchMedia("(pointer: coarse)").matches,
    memoryGigabytes: browser.deviceMemory,
    processors: browser.hardwareConcurrency,
  };
}
