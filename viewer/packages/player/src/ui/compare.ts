// SPDX-License-Identifier: Apache-2.0
/** A camera's own picture next to the reconstruction, with a movable line between them. */

import type { Camera } from "@structgstream/gl";
import type { Player } from "../player.js";
import { made } from "./dom.js";

export class Compare {
  readonly root: HTMLElement;
  private readonly image = made("img", { alt: "", draggable: "false" });
  private readonly handle: HTMLButtonElement;
  private names: ReadonlySet<string> = new Set();
  private folder: URL | undefined;
  private wanted = "";
  private loading = false;
  private split = 0.5;
  active = false;

  constructor(private readonly player: Player) {
    this.handle = made("button", {
      type: "button",
      class: "split",
      role: "slider",
      "aria-label": "Where the camera's picture ends",
      "aria-valuemin": "0",
      "aria-valuemax": "100",
    });
    const left = made("span", { class: "left" }, "Camera");
    const right = made("span", { class: "right" }, "Stream");
    this.root = made("div", { class: "compare", hidden: true }, this.image, left, right, this.handle);
    this.handle.addEventListener("pointerdown", (event) => this.handle.setPointerCapture(event.pointerId));
    this.handle.addEventListener("pointermove", (event) => {
      if (!this.handle.hasPointerCapture(event.pointerId)) return;
      const { left, width } = this.root.getBoundingClientRect();
      this.move((event.clientX - left) / Math.max(width, 1));
    });
    this.handle.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (by === undefined) return;
      this.move(this.split + by);
      event.preventDefault();
      event.stopPropagation();
    });
    this.image.addEventListener("load", () => this.loaded());
    this.image.addEventListener("error", () => this.loaded());
    this.move(this.split);
  }

  /** Requests the list of cameras with pictures; without an answer there are none. */
  async attach(list: URL): Promise<void> {
    const response = await fetch(list);
    const names: unknown = response.ok ? await response.json() : [];
    if (!Array.isArray(names)) return;
    this.names = new Set(names.filter((name) => typeof name === "string"));
    this.folder = new URL("truth/", list);
  }

  /** Whether any camera has pictures. */
  get possible(): boolean {
    return this.names.size > 0;
  }

  has(name: string | undefined): boolean {
    return name !== undefined && this.names.has(name);
  }

  /** A camera with pictures, preferably the present one. */
  offered(): string | undefined {
    const at = this.player.atCamera?.name;
    return this.has(at) ? at : [...this.names][0];
  }

  /** Aligns the picture with the camera's view on the canvas. */
  update(shown: Camera | undefined): void {
    const at = this.player.atCamera;
    const there = this.active && shown !== undefined && at !== undefined && this.has(at.name);
    this.player.exposed = there;
    this.root.hidden = !there;
    if (!there) return;
    const { width, height } = at.camera;
    const factor = Math.min(shown.width / width, shown.height / height);
    const percent = (part: number, whole: number) => `${((part / whole) * 100).toFixed(4)}%`;
    const { style } = this.root;
    style.width = percent(width * factor, shown.width);
    style.height = percent(height * factor, shown.height);
    style.left = percent((shown.width - width * factor) / 2, shown.width);
    style.top = percent((shown.height - height * factor) / 2, shown.height);
    this.show(at.name, this.player.stats?.frameIndex ?? 0);
  }

  private move(share: number): void {
    this.split = Math.min(Math.max(share, 0), 1);
    this.root.style.setProperty("--split", `${(this.split * 100).toFixed(2)}%`);
    this.handle.setAttribute("aria-valuenow", String(Math.round(this.split * 100)));
  }

  /** One picture is fetched at a time; during playback late ones are skipped. */
  private show(name: string, frame: number): void {
    const wanted = new URL(`${encodeURIComponent(name)}/${frame}.jpg`, this.folder).href;
    if (wanted === this.wanted) return;
    this.wanted = wanted;
    if (!this.loading) this.begin();
  }

  private begin(): void {
    this.loading = true;
    this.image.src = this.wanted;
  }

  private loaded(): void {
    this.loading = false;
    if (this.image.src !== this.wanted) this.begin();
  }
}
