// SPDX-License-Identifier: Apache-2.0
/** The user interface of a player: the picture, the controls over it, and their actions. */

import type { Player } from "../player.js";
import type { SourceDescription } from "../source/description.js";
import { linkTo } from "../view/link.js";
import type { QualityControl } from "../view/quality.js";
import type { RigCamera } from "../view/rig.js";
import type { XrMode } from "../xr/session.js";
import { Bar } from "./bar.js";
import { Compare } from "./compare.js";
import { made } from "./dom.js";
import { bytesText } from "./format.js";
import { Gestures } from "./gestures.js";
import { button, relabel } from "./icons.js";
import { Keyboard } from "./keyboard.js";
import { Notes } from "./notes.js";
import { Overlay } from "./overlay.js";
import { CameraPanel, helpContent, panel, pictureContent } from "./panels.js";
import { Statistics } from "./statistics.js";

const IDLE_SECONDS = 3;
const TOUR_SECONDS = 2.5;
const NARROW_PIXELS = 620;
const TINY_PIXELS = 400;

type PanelName = "cameras" | "settings" | "statistics" | "help";

export interface PlayerUiOptions {
  readonly host: HTMLElement;
  readonly canvas: HTMLCanvasElement;
  readonly player: Player;
  readonly quality: QualityControl;
  readonly open: (source: SourceDescription) => void;
  readonly saveScreenshot: () => void;
  readonly toggleXr: (mode: XrMode) => void;
  /** The address of the stream for links; undefined if a link cannot contain it. */
  readonly linkedSource: () => string | undefined;
}

export class PlayerUi {
  readonly root: HTMLElement;
  readonly compare: Compare;
  private readonly notes = new Notes();
  private readonly bar: Bar;
  private readonly overlay: Overlay;
  private readonly cameras: CameraPanel;
  private readonly statistics: Statistics;
  private readonly gestures: Gestures;
  private readonly keyboard: Keyboard;
  private readonly stage: HTMLElement;
  private readonly posterImage = made("img", { class: "poster", part: "poster", alt: "", hidden: true });
  private readonly drop = made("div", { class: "drop", hidden: true }, "Drop a stream to play it");
  private opened:
    | { readonly name: PanelName; readonly root: HTMLElement; readonly button: HTMLElement | undefined }
    | undefined;
  private touring = false;
  private movedAt = 0;
  private tickedAt: number | undefined;
  private playButton: HTMLElement | undefined;

  constructor(private readonly options: PlayerUiOptions) {
    const { player, canvas } = options;
    const go = (camera: RigCamera) => this.go(camera);
    this.overlay = new Overlay(go);
    this.overlay.visible = false;
    this.cameras = new CameraPanel({
      go,
      showFrusta: (shown) => {
        this.overlay.visible = shown;
      },
      tour: (on) => {
        this.touring = on;
      },
    });
    this.statistics = new Statistics(player);
    this.compare = new Compare(player);
    this.bar = new Bar(player, {
      toggle: (name, button) => this.toggle(name, button),
      compare: () => this.toggleCompare(),
      share: () => void this.share(),
      screenshot: () => options.saveScreenshot(),
      fullscreen: () => this.fullscreen(),
      toggleXr: (mode) => options.toggleXr(mode),
    });
    const label = "Scene: drag to turn around it, wheel or pinch to come closer";
    const stage = made("div", {
      class: "stage",
      part: "stage",
      tabindex: "0",
      role: "application",
      "aria-label": label,
    });
    this.stage = stage;
    canvas.setAttribute("part", "picture");
    stage.append(canvas, this.posterImage, this.overlay.root, this.compare.root);
    this.gestures = new Gestures(stage, player, () => this.tapped());
    const children = made("div", { class: "children" }, made("slot"));
    this.root = made("div", { class: "root" }, stage, children, this.notes.root, this.bar.root, this.drop);
    this.keyboard = new Keyboard(this.root, player, {
      fullscreen: () => this.fullscreen(),
      help: () => this.toggle("help"),
      home: () => this.home(),
      nextCamera: (by) => this.nextCamera(by),
      frusta: () => {
        this.overlay.visible = !this.overlay.visible;
      },
    });
    this.listen();
  }

  set embed(embed: boolean) {
    this.root.classList.toggle("embed", embed);
  }

  set controls(shown: boolean) {
    this.bar.root.hidden = !shown;
  }

  /** The address of a picture that is shown until the first of the stream is drawn. */
  set poster(address: string | undefined) {
    if (address === undefined) this.posterImage.removeAttribute("src");
    else if (this.posterImage.src !== address) this.posterImage.src = address;
    this.showPoster(!this.options.player.stats?.drawn && !this.playButton);
  }

  /** Shows the button of a kind of session, if the device offers it. */
  offerXr(mode: XrMode, offered: boolean): void {
    this.bar.xr[mode].hidden = !offered;
  }

  /** Shows which session runs, if one does. */
  set xr(running: XrMode | undefined) {
    for (const [mode, button] of Object.entries(this.bar.xr)) {
      relabel(button, button.title.replace(/^\w+/, mode === running ? "Leave" : "Enter"));
      button.setAttribute("aria-pressed", String(mode === running));
    }
  }

  private showPoster(shown: boolean): void {
    this.posterImage.hidden = !shown || !this.posterImage.hasAttribute("src");
    this.root.classList.toggle("posted", !this.posterImage.hidden);
  }

  /** Shows that another stream is being opened. */
  begin(name: string): void {
    this.closePanel();
    this.playButton = undefined;
    this.showPoster(true);
    this.notes.say("", 0);
    this.notes.loading(0, undefined, `Opening ${name.replace(/^The /, "the ")}`);
    if (this.options.player.engine) this.bar.timeline.attach(this.options.player.engine);
  }

  fail(message: string): void {
    this.notes.fail(message);
  }

  say(message: string, bad = false): void {
    this.notes.say(message, performance.now() / 1000, bad);
  }

  /** Shows that no stream is selected. */
  invite(): void {
    const choose = made("button", { type: "button", class: "glass" }, "Open a stream");
    choose.style.pointerEvents = "auto";
    choose.addEventListener("click", () => this.chooseFile());
    this.notes.show(choose, made("p", { class: "soft" }, "or drop a file here"));
  }

  /** Must be called after the player's own tick. */
  tick(): void {
    const { player } = this.options;
    const now = performance.now() / 1000;
    const seconds = this.tickedAt === undefined ? 0 : now - this.tickedAt;
    this.tickedAt = now;
    this.keyboard.tick(seconds);
    this.notes.tick(now);
    this.bar.update();
    this.bar.compare.hidden = !this.compare.possible;
    this.bar.compare.setAttribute("aria-pressed", String(this.compare.active));
    this.cameras.update(player.atCamera);
    if (this.opened?.name === "statistics") this.statistics.update(now);
    const { camera } = player;
    if (camera) this.overlay.update(camera, player.atCamera);
    this.compare.update(camera);
    if (this.touring && !player.flying) this.nextCamera(1, TOUR_SECONDS);
    const active = now - this.movedAt < IDLE_SECONDS || this.opened !== undefined;
    this.root.classList.toggle("idle", !active && player.engine?.paused === false);
    if (player.touched && this.playButton?.isConnected) this.notes.show();
    this.tellEdge();
  }

  resize(width: number): void {
    this.root.classList.toggle("narrow", width < NARROW_PIXELS);
    this.root.classList.toggle("tiny", width < TINY_PIXELS);
    this.bar.timeline.changed();
  }

  private listen(): void {
    const { player } = this.options;
    const root = this.root;
    for (const name of ["pointermove", "pointerdown", "keydown"] as const) {
      root.addEventListener(name, () => {
        this.movedAt = performance.now() / 1000;
      });
    }
    root.addEventListener("dragover", (event) => {
      event.preventDefault();
      this.drop.hidden = false;
    });
    root.addEventListener("dragleave", () => {
      this.drop.hidden = true;
    });
    root.addEventListener("drop", (event) => {
      event.preventDefault();
      this.drop.hidden = true;
      this.openFirst(event.dataTransfer?.files);
    });
    player.on("opening", ({ loadedBytes, totalBytes, ended }) => {
      const rest = ended
        ? ": the stream ends within its header. It is being written, or was cut off; waiting for more."
        : totalBytes && ` of ${bytesText(totalBytes)}`;
      this.notes.loading(loadedBytes, totalBytes, bytesText(loadedBytes) + (rest ?? ""));
    });
    player.on("header", () => this.notes.loading(1, 1, "Decoding"));
    player.on("rig", ({ rig }) => {
      this.overlay.attach(rig);
      this.cameras.attach(rig);
    });
    player.on("drawn", () => this.pictureCame());
    player.on("progress", () => this.bar.timeline.changed());
    player.on("state", () => this.stateChanged());
    player.on("notice", ({ message }) => this.say(message));
    player.on("stall", ({ stalled }) => {
      if (stalled && !player.engine?.edge.grows) this.notes.speak("Waiting for data");
    });
    player.on("error", ({ message, fatal }) => {
      if (fatal) this.fail(message);
      else this.say(message, true);
    });
  }

  /** Shows a large play button over the first picture of a paused stream. */
  private pictureCame(): void {
    if (this.playButton) return;
    this.showPoster(false);
    const { engine } = this.options.player;
    this.playButton = button("play", "Play", () => engine?.play(), "big glass");
    if (engine?.paused && (!engine.edge.grows || engine.edge.live) && engine.frames.count > 1)
      this.notes.show(this.playButton);
    else this.notes.show();
  }

  private stateChanged(): void {
    const { engine } = this.options.player;
    if (!this.playButton?.isConnected || !engine) return;
    if (!engine.paused || engine.frameIndex > 0) this.notes.show();
  }

  private tellEdge(): void {
    const { engine } = this.options.player;
    if (!engine?.edge.grows || engine.edge.flows || engine.paused || !engine.stalled) return;
    const seconds = engine.nextFrameSeconds;
    const when = !seconds ? "the next is awaited" : `next in about ${Math.ceil(seconds)} s`;
    this.notes.status(`Frame ${engine.frames.count - 1}, ${when}`, performance.now() / 1000);
  }

  private tapped(): void {
    if (this.opened) this.closePanel();
    else this.options.player.toggle();
  }

  private go(camera: RigCamera, seconds?: number): void {
    this.options.player.flyTo(camera, seconds);
    if (!this.touring) this.notes.speak(`Camera ${camera.name}`);
  }

  private nextCamera(by: number, seconds?: number): void {
    const { rig, atCamera } = this.options.player;
    if (!rig) return;
    const at = atCamera ? rig.cameras.indexOf(atCamera) : by > 0 ? -1 : 0;
    const count = rig.cameras.length;
    this.go(rig.cameras[(((at + by) % count) + count) % count]!, seconds);
  }

  private home(): void {
    const { player } = this.options;
    if (player.rig) this.go(player.rig.first);
  }

  private toggleCompare(): void {
    const { player } = this.options;
    this.compare.active = !this.compare.active;
    if (!this.compare.active || this.compare.has(player.atCamera?.name)) return;
    const camera = player.rig?.cameras.find(({ name }) => name === this.compare.offered());
    if (camera) this.go(camera);
  }

  private toggle(name: PanelName, button?: HTMLButtonElement): void {
    const same = this.opened?.name === name;
    this.closePanel();
    if (same) return;
    const titles = { cameras: "Cameras", settings: "Picture", statistics: "Statistics", help: "Keys and gestures" };
    const root = panel(titles[name], () => this.closePanel(), ...this.contentOf(name));
    this.root.append(root);
    button?.setAttribute("aria-expanded", "true");
    this.opened = { name, root, button };
  }

  private contentOf(name: PanelName): Node[] {
    const { player, quality, host } = this.options;
    if (name === "cameras") return this.cameras.content(this.overlay.visible, this.touring);
    if (name === "statistics") return this.statistics.content();
    if (name === "help") return helpContent();
    return pictureContent(quality, player, {
      flying: this.gestures.flying,
      setFlying: (flying) => {
        this.gestures.flying = flying;
      },
      theme: host.getAttribute("theme") ?? "auto",
      setTheme: (theme) => host.setAttribute("theme", theme),
      openFile: () => this.chooseFile(),
      more: [
        ["Statistics", () => this.toggle("statistics")],
        ["Save a screenshot", () => this.options.saveScreenshot()],
        ["Copy a link", () => void this.share()],
        ["Keys and gestures", () => this.toggle("help")],
      ],
    });
  }

  private closePanel(): void {
    const { opened, stage } = this;
    if (!opened) return;
    this.opened = undefined;
    const focused = opened.root.matches(":focus-within");
    opened.button?.setAttribute("aria-expanded", "false");
    opened.root.remove();
    if (!focused) return;
    // Where the focus goes with its element, keys do nothing any more. A small player may hide the button.
    stage.focus();
    opened.button?.focus();
  }

  private chooseFile(): void {
    const input = made("input", { type: "file", accept: ".sgs" });
    input.addEventListener("change", () => this.openFirst(input.files));
    input.click();
  }

  private openFirst(files: FileList | null | undefined): void {
    const file = files?.[0];
    if (file) this.options.open({ kind: "blob", blob: file, name: file.name });
  }

  private async share(): Promise<void> {
    const { player, linkedSource } = this.options;
    if (!player.view || !player.engine) return;
    const link = linkTo(new URL(location.href), linkedSource(), player.engine.currentTime, player.view);
    try {
      await navigator.clipboard.writeText(link);
      this.say("The link to this view and time is copied.");
    } catch {
      this.say(`This page may not write to the clipboard; the link is ${link}`);
    }
  }

  private fullscreen(): void {
    const { host } = this.options;
    const asked = document.fullscreenElement ? document.exitFullscreen() : host.requestFullscreen?.();
    asked?.catch(() => this.say("The browser does not let this page fill the screen."));
  }
}
