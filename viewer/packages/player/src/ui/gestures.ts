// SPDX-License-Identifier: Apache-2.0
/** Gestures on the picture: touch, mouse and wheel. */

import type { Player } from "../player.js";
import { dollied, looked, orbited, panned, type View } from "../view/navigator.js";

/** Rotation by a drag across the picture's height. */
const TURN_RADIANS = Math.PI;
const WHEEL_LINE_PIXELS = 16;
const WHEEL_PAGE_PIXELS = 400;
const WHEEL_SPEED = 0.0016;
const CLICK_PIXELS = 5;

interface Finger {
  x: number;
  y: number;
}

export class Gestures {
  /** Dragging turns the camera around its position instead of around the scene. */
  flying = false;
  private readonly fingers = new Map<number, Finger>();
  private travelled = 0;
  private button = 0;

  /** @param tap called for a click or tap that did not move */
  constructor(
    private readonly stage: HTMLElement,
    private readonly player: Player,
    private readonly tap: () => void,
  ) {
    stage.addEventListener("pointerdown", (event) => this.down(event));
    stage.addEventListener("pointermove", (event) => this.move(event));
    stage.addEventListener("pointerup", (event) => this.up(event));
    stage.addEventListener("pointercancel", (event) => this.fingers.delete(event.pointerId));
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  private down(event: PointerEvent): void {
    if (event.target instanceof Element && event.target.closest("button, .frustum")) return;
    this.stage.setPointerCapture(event.pointerId);
    if (this.fingers.size === 0) this.travelled = 0;
    this.button = event.button;
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  private move(event: PointerEvent): void {
    const finger = this.fingers.get(event.pointerId);
    if (!finger) return;
    const [x, y] = [event.clientX - finger.x, event.clientY - finger.y];
    this.travelled += Math.hypot(x, y);
    const others = [...this.fingers.entries()].filter(([id]) => id !== event.pointerId).map(([, other]) => other);
    const { height } = this.stage.getBoundingClientRect();
    const pixels = (this.player.camera?.height ?? 1) / Math.max(height, 1);
    if (this.travelled > CLICK_PIXELS) {
      if (others[0]) this.pinch(finger, { x: event.clientX, y: event.clientY }, others[0], pixels);
      else this.drag(x, y, height, pixels, event);
    }
    finger.x = event.clientX;
    finger.y = event.clientY;
  }

  private drag(x: number, y: number, height: number, pixels: number, event: PointerEvent): void {
    const [yaw, pitch] = [(-x / height) * TURN_RADIANS, (y / height) * TURN_RADIANS];
    const pans = this.button !== 0 || event.shiftKey || event.ctrlKey || event.metaKey;
    this.player.navigate((view, { up }) => {
      if (pans) return this.pannedBy(view, x * pixels, y * pixels);
      return this.flying ? looked(view, yaw / 2, -pitch / 2, up) : orbited(view, yaw, pitch, up);
    });
  }

  /** Two fingers: the content between them stays there. */
  private pinch(from: Finger, to: Finger, other: Finger, pixels: number): void {
    const before = Math.hypot(from.x - other.x, from.y - other.y);
    const after = Math.hypot(to.x - other.x, to.y - other.y);
    const factor = Math.min(Math.max(before / Math.max(after, 1), 0.5), 2);
    const [x, y] = [(to.x - from.x) / 2, (to.y - from.y) / 2];
    this.player.navigate((view) => this.pannedBy(dollied(view, factor), x * pixels, y * pixels));
  }

  /** Moves by pixels of the canvas, whose camera differs from that of the view. */
  private pannedBy(view: View, x: number, y: number): View {
    const shown = this.player.camera;
    const factor = shown ? view.camera.K.fx / shown.K.fx : 1;
    return panned(view, x * factor, y * factor);
  }

  private up(event: PointerEvent): void {
    const was = this.fingers.delete(event.pointerId);
    if (was && this.fingers.size === 0 && this.travelled <= CLICK_PIXELS && event.button === 0) this.tap();
  }

  private wheel(event: WheelEvent): void {
    event.preventDefault();
    const unit = [1, WHEEL_LINE_PIXELS, WHEEL_PAGE_PIXELS][event.deltaMode] ?? 1;
    const pixels = Math.min(Math.max(event.deltaY * unit, -WHEEL_PAGE_PIXELS), WHEEL_PAGE_PIXELS);
    // A pinch on a touchpad is a wheel event with Ctrl, in smaller steps.
    const speed = event.ctrlKey ? 6 * WHEEL_SPEED : WHEEL_SPEED;
    this.player.navigate((view) => dollied(view, Math.exp(pixels * speed)));
  }
}
