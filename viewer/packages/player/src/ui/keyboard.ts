// SPDX-License-Identifier: Apache-2.0
/** Keyboard: the keys of video players for time, and those of games for the camera. */

import type { Player } from "../player.js";
import { dollied, flown, orbited } from "../view/navigator.js";

/** Actions of keys outside the player itself; see the list of keys. */
export interface KeyActions {
  fullscreen(): void;
  help(): void;
  home(): void;
  nextCamera(by: number): void;
  frusta(): void;
}

/** The list of keys in the help panel. */
export const KEYS: readonly (readonly [keys: readonly string[], does: string])[] = [
  [["Space", "K"], "play, pause"],
  [["←", "→"], "a second back, forward"],
  [[",", "."], "a frame back, forward"],
  [["Home", "End"], "first, last frame, or live"],
  [["<", ">"], "slower, faster"],
  [["L"], "loop"],
  [["M"], "mute, unmute"],
  [["W", "A", "S", "D", "Q", "E"], "fly"],
  [["Shift + arrows"], "turn around the scene"],
  [["+", "-"], "closer, farther"],
  [["C", "V"], "next, previous camera"],
  [["G"], "show the rig's cameras"],
  [["R"], "reset the view"],
  [["F"], "full screen"],
];

const FLY: Readonly<Record<string, readonly [right: number, down: number, forward: number]>> = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyQ: [0, 1, 0],
  KeyE: [0, -1, 0],
};
/** Speed of flying, in radii of the rig per second. */
const FLY_SPEED = 0.7;
const TURN_RADIANS = 0.08;
const DOLLY = 0.9;
/** Speeds to choose from. */
export const RATES = [0.1, 0.25, 0.5, 1, 1.5, 2, 4];

export class Keyboard {
  private readonly held = new Set<string>();

  constructor(
    root: HTMLElement,
    private readonly player: Player,
    private readonly actions: KeyActions,
  ) {
    root.addEventListener("keydown", (event) => this.down(event));
    root.addEventListener("keyup", (event) => this.held.delete(event.code));
    root.addEventListener("focusout", () => this.held.clear());
  }

  /** Moves by the pressed keys; must be called with every picture. */
  tick(seconds: number): void {
    if (!this.held.size) return;
    const step = Math.min(seconds, 0.1) * FLY_SPEED;
    this.player.navigate((view, { radius }) => {
      const sum = [0, 0, 0];
      for (const code of this.held) {
        for (const [i, part] of FLY[code]!.entries()) sum[i]! += part * step * radius;
      }
      return flown(view, sum[0]!, sum[1]!, sum[2]!);
    });
  }

  private down(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const from = event.composedPath()[0];
    if (from instanceof HTMLSelectElement || (from instanceof HTMLInputElement && from.type === "range")) return;
    // Space and Enter activate the focused button.
    if (from instanceof HTMLButtonElement && (event.key === " " || event.key === "Enter")) return;
    if (FLY[event.code] && !event.shiftKey) this.held.add(event.code);
    else if (!this.time(event) && !this.view(event)) return;
    event.preventDefault();
    event.stopPropagation();
  }

  private time(event: KeyboardEvent): boolean {
    const { player } = this;
    const { engine } = player;
    const { playbackRate } = player;
    const slower = RATES.filter((rate) => rate < playbackRate).at(-1);
    const faster = RATES.find((rate) => rate > playbackRate);
    const act: Readonly<Record<string, () => void>> = {
      " ": () => player.toggle(),
      k: () => player.toggle(),
      ArrowLeft: () => engine?.seek(engine.currentTime - 1),
      ArrowRight: () => engine?.seek(engine.currentTime + 1),
      ",": () => engine?.step(-1),
      ".": () => engine?.step(1),
      Home: () => engine?.seekFrame(0),
      End: () => player.goToNewest(),
      "<": () => {
        player.playbackRate = slower ?? playbackRate;
      },
      ">": () => {
        player.playbackRate = faster ?? playbackRate;
      },
      l: () => player.setLoop(!player.loop),
      m: () => player.toggleSound(),
    };
    if (event.shiftKey && event.key.startsWith("Arrow")) return false;
    return called(act, event.key);
  }

  private view(event: KeyboardEvent): boolean {
    const { player, actions } = this;
    const turn = (yaw: number, pitch: number) => () =>
      player.navigate((view, { up }) => orbited(view, yaw * TURN_RADIANS, pitch * TURN_RADIANS, up));
    const dolly = (factor: number) => () => player.navigate((view) => dollied(view, factor));
    const turns = { ArrowLeft: turn(-1, 0), ArrowRight: turn(1, 0), ArrowUp: turn(0, 1), ArrowDown: turn(0, -1) };
    if (event.shiftKey && called(turns, event.key)) return true;
    const act: Readonly<Record<string, () => void>> = {
      ArrowUp: dolly(DOLLY),
      ArrowDown: dolly(1 / DOLLY),
      "+": dolly(DOLLY),
      "=": dolly(DOLLY),
      "-": dolly(1 / DOLLY),
      c: () => actions.nextCamera(1),
      v: () => actions.nextCamera(-1),
      g: () => actions.frusta(),
      r: () => actions.home(),
      f: () => actions.fullscreen(),
      "?": () => actions.help(),
    };
    return called(act, event.key);
  }
}

function called(actions: Readonly<Record<string, () => void>>, key: string): boolean {
  const name = key.length === 1 ? key.toLowerCase() : key;
  if (!Object.hasOwn(actions, name)) return false;
  actions[name]?.();
  return true;
}
