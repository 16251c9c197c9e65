// SPDX-License-Identifier: Apache-2.0
/** Side panels: cameras, picture quality, keys. Statistics have a module of their own. */

import type { Player } from "../player.js";
import type { QualityChoice, QualityControl } from "../view/quality.js";
import type { Rig, RigCamera } from "../view/rig.js";
import { made } from "./dom.js";
import { button } from "./icons.js";
import { KEYS } from "./keyboard.js";

export function panel(title: string, close: () => void, ...children: Node[]): HTMLElement {
  const head = made("h2", {}, title, button("close", "Close", close));
  return made("section", { class: "panel glass", part: "panel", "aria-label": title }, head, ...children);
}

function choice<Value extends string>(
  label: string,
  options: readonly (readonly [Value, string])[],
  value: Value,
  taken: (value: Value) => void,
): HTMLElement {
  const select = made("select");
  for (const [name, text] of options) select.append(made("option", { value: name, selected: name === value }, text));
  select.addEventListener("change", () => taken(select.value as Value));
  return made("label", {}, label, select);
}

export interface CameraActions {
  go(camera: RigCamera): void;
  showFrusta(shown: boolean): void;
  tour(on: boolean): void;
}

export class CameraPanel {
  readonly list = made("div", { class: "list" });
  private buttons: { readonly camera: RigCamera; readonly element: HTMLButtonElement }[] = [];
  private at: RigCamera | undefined;

  constructor(private readonly actions: CameraActions) {}

  attach(rig: Rig): void {
    this.at = undefined;
    this.buttons = rig.cameras.map((camera) => {
      const name = camera.heldOut ? `${camera.name}, not used for training` : camera.name;
      const attributes = { type: "button", title: name, "aria-label": name, class: camera.heldOut ? "heldout" : "" };
      const element = made("button", attributes, camera.name);
      element.addEventListener("click", () => this.actions.go(camera));
      return { camera, element };
    });
    this.list.replaceChildren(...this.buttons.map(({ element }) => element));
  }

  content(frusta: boolean, touring: boolean): Node[] {
    const toggle = (label: string, on: boolean, taken: (on: boolean) => void) => {
      const box = made("input", { type: "checkbox", checked: on });
      box.addEventListener("change", () => taken(box.checked));
      return made("label", {}, label, box);
    };
    return [
      toggle("Show them in the picture", frusta, (on) => this.actions.showFrusta(on)),
      toggle("Fly from one to the next", touring, (on) => this.actions.tour(on)),
      this.list,
      made("p", { class: "remark" }, "Dashed: not used for training."),
    ];
  }

  update(at: RigCamera | undefined): void {
    if (at === this.at) return;
    this.at = at;
    for (const { camera, element } of this.buttons) {
      if (camera === at) element.setAttribute("aria-current", "true");
      else element.removeAttribute("aria-current");
    }
  }
}

const SPLATS = ["auto", "1000000", "500000", "200000", "100000", "50000"] as const;
const SCALES = ["auto", "1", "0.75", "0.5", "0.35"] as const;
const THEMES = ["auto", "dark", "light"] as const;

export interface PictureActions {
  readonly flying: boolean;
  setFlying(flying: boolean): void;
  readonly theme: string;
  setTheme(theme: string): void;
  openFile(): void;
  /** Actions that do not fit into the bar on a small screen: labels and functions. */
  readonly more: readonly (readonly [label: string, act: () => void])[];
}

export function pictureContent(quality: QualityControl, player: Player, actions: PictureActions): Node[] {
  const set = (changed: Partial<QualityChoice>) => {
    quality.choice = { ...quality.choice, ...changed };
  };
  const value = (text: string) => (text === "auto" ? "auto" : Number(text));
  const { maxSplats, pixelScale } = quality.choice;
  const splats = SPLATS.map(
    (name) => [name, name === "auto" ? "automatic" : Number(name).toLocaleString("en")] as const,
  );
  const scales = SCALES.map((name) => [name, name === "auto" ? "automatic" : `${Number(name) * 100} %`] as const);
  const acting = (label: string, act: () => void, name = "") => {
    const element = made("button", { type: "button", class: name }, label);
    element.addEventListener("click", act);
    return element;
  };
  const { engine } = player;
  const names = engine?.qualities.names ?? [];
  const qualities = [["auto", "automatic"] as const, ...names.map((name, i) => [String(i), name] as const)];
  const taken = (text: string) => engine?.chooseQuality(text === "auto" ? undefined : Number(text));
  const chosen = engine?.quality === undefined ? "auto" : String(engine.quality);
  return [
    ...(names.length > 1 ? [choice("Stream", qualities, chosen, taken)] : []),
    choice("Splats, at most", splats, String(maxSplats) as "auto", (text) => set({ maxSplats: value(text) })),
    choice("Resolution", scales, String(pixelScale) as "auto", (text) => set({ pixelScale: value(text) })),
    choice(
      "Dragging",
      [
        ["orbit", "turns around the scene"],
        ["fly", "looks around"],
      ] as const,
      actions.flying ? "fly" : "orbit",
      (mode) => actions.setFlying(mode === "fly"),
    ),
    choice(
      "Colours",
      THEMES.map((name) => [name, name === "auto" ? "as the system's" : name] as const),
      actions.theme as "auto",
      (name) => actions.setTheme(name),
    ),
    choice(
      "Motion",
      [
        ["smooth", "flies to cameras"],
        ["still", "jumps to cameras"],
      ] as const,
      player.still ? "still" : "smooth",
      (motion) => {
        player.still = motion === "still";
      },
    ),
    acting("Open a file", () => actions.openFile(), "file"),
    made("div", { class: "more" }, ...actions.more.map(([label, act]) => acting(label, act))),
  ];
}

export function helpContent(): Node[] {
  const list = made("dl", { class: "keys" });
  for (const [keys, does] of KEYS) {
    const names = keys.flatMap((key, i) => (i ? [" ", made("kbd", {}, key)] : [made("kbd", {}, key)]));
    list.append(made("dt", {}, ...names), made("dd", {}, does));
  }
  const mouse = [
    ["Drag", "turn around the scene"],
    ["Right drag, two fingers", "move sideways"],
    ["Wheel, pinch", "closer, farther"],
  ];
  for (const [gesture, does] of mouse) list.append(made("dt", {}, gesture!), made("dd", {}, does!));
  return [list];
}
