// SPDX-License-Identifier: Apache-2.0
/** The rig's cameras as frusta over the picture; a click selects a camera. */

import { type Camera, center, frustum, projected, type Vector } from "@structgstream/gl";
import type { Rig, RigCamera } from "../view/rig.js";
import { madeSvg } from "./dom.js";

/** Depth of a frustum in radii of the rig. */
const DEPTH = 0.12;

interface Drawn {
  readonly camera: RigCamera;
  readonly group: SVGGElement;
  readonly path: SVGPathElement;
  readonly label: SVGTextElement;
  readonly eye: Vector;
  readonly corners: readonly Vector[];
}

export class Overlay {
  readonly root = madeSvg("svg", { class: "overlay", "aria-hidden": "true" });
  private drawn: Drawn[] = [];
  private shown = false;

  /** @param go called with the camera that was clicked */
  constructor(private readonly go: (camera: RigCamera) => void) {}

  get visible(): boolean {
    return this.shown;
  }

  set visible(visible: boolean) {
    this.shown = visible;
    this.root.toggleAttribute("hidden", !visible);
  }

  attach(rig: Rig): void {
    this.drawn = rig.cameras.map((camera) => {
      const path = madeSvg("path");
      const label = madeSvg("text");
      label.textContent = camera.name;
      const group = madeSvg("g", { class: camera.heldOut ? "frustum heldout" : "frustum" }, path, label);
      group.addEventListener("click", () => this.go(camera));
      const corners = frustum(camera.camera, DEPTH * rig.radius);
      return { camera, group, path, label, eye: center(camera.camera), corners };
    });
    this.root.replaceChildren(...this.drawn.map(({ group }) => group));
  }

  /** Draws the frusta for `camera`; `at` is the rig's camera whose view is shown, which is left out. */
  update(camera: Camera, at: RigCamera | undefined): void {
    if (!this.shown) return;
    this.root.setAttribute("viewBox", `0 0 ${camera.width} ${camera.height}`);
    for (const { camera: own, group, path, label, eye, corners } of this.drawn) {
      const points = [eye, ...corners].map((point) => projected(camera, point));
      const seen = own !== at && points.every((point) => point && point.depth > camera.near * 0.2);
      group.toggleAttribute("hidden", !seen);
      if (!seen) continue;
      const [tip, ...base] = points.map((point) => `${point!.x.toFixed(1)} ${point!.y.toFixed(1)}`);
      const sides = base.map((corner) => `M${tip}L${corner}`).join("");
      path.setAttribute("d", `M${base.join("L")}Z${sides}`);
      label.setAttribute("x", points[0]!.x.toFixed(1));
      label.setAttribute("y", (points[0]!.y - 6).toFixed(1));
    }
  }
}
