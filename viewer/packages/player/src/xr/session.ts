// SPDX-License-Identifier: Apache-2.0
/** A WebXR session that shows the player's stream in a headset, or on a telephone in front of the camera's picture. */

import { along, type EyeView, length, type Vector } from "@structgstream/gl";
import type { Player } from "../player.js";
import { FrameBudget, type QualityControl } from "../view/quality.js";
import { nearPlane } from "../view/rig.js";
import {
  assumedMetres,
  eyeCamera,
  floorHeight,
  inScene,
  type Matrix,
  middleOf,
  positionOf,
  pulled,
  type Room,
  standingAt,
  turned,
} from "./room.js";

export const XR_MODES = ["immersive-vr", "immersive-ar"] as const;
export type XrMode = (typeof XR_MODES)[number];

export interface XrOptions {
  readonly canvas: HTMLCanvasElement;
  readonly player: Player;
  readonly quality: QualityControl;
  /** Metres per unit of the capture; undefined: as `assumedMetres` finds. */
  readonly metres: number | undefined;
  /** Called once, when the session has ended for whatever reason. */
  readonly onEnd: () => void;
}

/** A hand, or a controller, whose trigger or grip is pressed. */
interface Hold {
  /** A trigger that is released where it was pressed plays and pauses. */
  readonly trigger: boolean;
  /** In the room. */
  start: Vector | undefined;
  last: Vector | undefined;
  pulls: boolean;
}

/** Of devices that do not state theirs; telephones' cameras have 30. */
const FRAMES_PER_SECOND: Readonly<Record<XrMode, number>> = { "immersive-vr": 72, "immersive-ar": 30 };
/** Eyes above the floor where the device does not know the floor. */
const EYE_METRES = 1.6;
/** A trigger that moves farther pulls the scene. */
const PULL_METRES = 0.03;
const SNAP_RADIANS = Math.PI / 6;
/** Deflections of a stick at which the view turns, is ready to turn again, and moves. */
const [TURNS, RELEASED, MOVES] = [0.7, 0.3, 0.2];
const METRES_PER_SECOND = 1.5;
const LONGEST_STEP_SECONDS = 0.1;

/** Whether this browser and device offer a kind of session. */
export async function offersXr(mode: XrMode): Promise<boolean> {
  try {
    return (await navigator.xr?.isSessionSupported(mode)) ?? false;
  } catch {
    return false; // a page whose permissions policy forbids WebXR
  }
}

export class XrSession {
  private room: Room | undefined;
  private readonly budget: FrameBudget;
  private readonly holds = new Map<XRInputSource, Hold>();
  /** Sticks that have turned the view and were not released since. */
  private readonly snapped = new Set<XRInputSource>();
  private framedAt: number | undefined;

  private constructor(
    readonly mode: XrMode,
    private readonly session: XRSession,
    private readonly layer: XRWebGLLayer,
    private readonly space: XRReferenceSpace,
    private readonly options: XrOptions,
  ) {
    const { player, quality, canvas, onEnd } = options;
    this.budget = new FrameBudget(quality, 1 / (session.frameRate || FRAMES_PER_SECOND[mode]));
    const ended = () => void this.end();
    const listeners = [
      player.on("header", () => {
        this.room = undefined;
      }),
      player.on("error", ({ fatal }) => fatal && ended()),
    ];
    // The session's framebuffer is lost with the context.
    canvas.addEventListener("webglcontextlost", ended);
    session.addEventListener("end", () => {
      for (const remove of listeners) remove();
      canvas.removeEventListener("webglcontextlost", ended);
      onEnd();
    });
    for (const name of ["select", "squeeze"] as const) {
      const trigger = name === "select";
      session.addEventListener(`${name}start`, ({ inputSource }) => {
        if (this.holds.has(inputSource)) return;
        this.holds.set(inputSource, { trigger, start: undefined, last: undefined, pulls: !trigger });
      });
      session.addEventListener(`${name}end`, ({ inputSource }) => {
        const hold = this.holds.get(inputSource);
        if (hold?.trigger !== trigger) return;
        this.holds.delete(inputSource);
        if (!hold.pulls) player.toggle();
      });
    }
    session.requestAnimationFrame(this.frame);
  }

  /** @throws Error a sentence that says why there is no session */
  static async start(mode: XrMode, options: XrOptions): Promise<XrSession> {
    const { xr } = navigator;
    if (!xr) {
      throw new Error(
        "This browser has no WebXR; open the page in a headset's browser, over HTTPS or from the machine itself.",
      );
    }
    let session: XRSession;
    try {
      session = await xr.requestSession(mode, { optionalFeatures: ["local-floor", "hand-tracking"] });
    } catch (error) {
      if (error instanceof DOMException && error.name === "NotSupportedError") {
        throw new Error(`This device does not offer ${mode}; connect a headset, or ask for the other kind of session.`);
      }
      throw new Error(`The session was refused (${reasonOf(error)}); ask for it in a click, and allow it.`);
    }
    try {
      const gl = options.canvas.getContext("webgl2")!;
      await gl.makeXRCompatible();
      const layer = new XRWebGLLayer(session, gl, { antialias: false, depth: false });
      session.updateRenderState({ baseLayer: layer });
      return new XrSession(mode, session, layer, await floorSpace(session), options);
    } catch (error) {
      await session.end().catch(() => undefined);
      throw new Error(`The headset cannot show this player's pictures (${reasonOf(error)}); load the page again.`);
    }
  }

  /** Whether nobody sees its pictures, and none are asked for: the headset was taken off, say. */
  get hidden(): boolean {
    return this.session.visibilityState === "hidden";
  }

  async end(): Promise<void> {
    await this.session.end().catch(() => undefined); // it may have ended
  }

  private readonly frame = (milliseconds: number, frame: XRFrame): void => {
    this.session.requestAnimationFrame(this.frame);
    const seconds = Math.min((milliseconds - (this.framedAt ?? milliseconds)) / 1000, LONGEST_STEP_SECONDS);
    this.framedAt = milliseconds;
    const pose = frame.getViewerPose(this.space);
    if (!pose) return; // the headset is being searched for
    this.place(pose.transform.matrix);
    if (!this.room) return;
    this.pull(frame);
    this.useSticks(pose.transform.matrix, seconds);
    const eyes = this.eyesOf(this.room, pose);
    if (!eyes.length) return;
    const { framebuffer } = this.layer;
    const middle = middleOf(eyes.map(({ camera }) => camera));
    const transparent = this.session.environmentBlendMode !== "opaque";
    this.options.player.tick(true, { eyes, middle, framebuffer, transparent, quality: this.budget });
  };

  /** Puts the viewer into the scene of a new stream. */
  private place(head: Matrix): void {
    const { rig, view, engine } = this.options.player;
    if (this.room || !rig || !view || !engine?.header) return;
    const { similarity, static: fixed, reference } = engine.header;
    const scale = similarity.scale / (this.options.metres ?? assumedMetres(rig, similarity.scale));
    const anchors = (fixed.get("anchor_positions") ?? reference.get("anchor_positions"))?.data as
      | Float32Array
      | undefined;
    this.room = standingAt(view, rig.up, floorHeight(rig, scale, anchors), scale, head);
  }

  private eyesOf(room: Room, pose: XRViewerPose): EyeView[] {
    const { rig } = this.options.player;
    const head = inScene(room, positionOf(pose.transform.matrix));
    const near = Math.max(rig ? nearPlane(rig, head) : 0, this.session.renderState.depthNear * room.scale);
    return pose.views.flatMap((view) => {
      const part = this.layer.getViewport(view);
      if (!part?.width || !part.height) return []; // an eye that is not shown now
      const { x, y, width, height } = part;
      return { camera: eyeCamera(room, view.transform.matrix, view.projectionMatrix, width, height, near), x, y };
    });
  }

  /** Hands that hold the scene pull it along. */
  private pull(frame: XRFrame): void {
    const [before, after]: [Vector[], Vector[]] = [[], []];
    for (const [source, hold] of this.holds) {
      const pose = frame.getPose(source.gripSpace ?? source.targetRaySpace, this.space);
      if (!pose) continue;
      const at = positionOf(pose.transform.matrix);
      hold.start ??= at;
      if (hold.pulls && hold.last) {
        before.push(hold.last);
        after.push(at);
      }
      hold.pulls ||= length(along(at, hold.start, -1)) > PULL_METRES;
      hold.last = at;
    }
    if (this.room) this.room = pulled(this.room, before, after);
  }

  /** Sideways a stick turns by steps, which are easier to bear than a smooth turn; forward and back it moves. */
  private useSticks(head: Matrix, seconds: number): void {
    for (const source of this.session.inputSources) {
      const [x, y] = (source.gamepad?.axes.slice(-2) ?? []) as [number?, number?];
      if (!this.room || x === undefined || y === undefined) continue;
      if (Math.abs(x) < RELEASED) this.snapped.delete(source);
      if (Math.abs(x) > TURNS && !this.snapped.has(source)) {
        this.snapped.add(source);
        this.room = turned(this.room, positionOf(head), Math.sign(x) * SNAP_RADIANS);
      } else if (Math.abs(y) > MOVES && Math.abs(y) > Math.abs(x)) {
        const [backX, backZ] = [head[8]!, head[10]!];
        const step = (y * METRES_PER_SECOND * seconds) / Math.max(Math.hypot(backX, backZ), 1e-6);
        this.room = pulled(this.room, [[backX * step, 0, backZ * step]], [[0, 0, 0]]);
      }
    }
  }
}

/** The room with its floor at 0, or with an assumed floor on devices that do not know it. */
async function floorSpace(session: XRSession): Promise<XRReferenceSpace> {
  try {
    return await session.requestReferenceSpace("local-floor");
  } catch {
    const space = await session.requestReferenceSpace("local");
    return space.getOffsetReferenceSpace(new XRRigidTransform({ x: 0, y: -EYE_METRES, z: 0 }));
  }
}

function reasonOf(error: unknown): string {
  return (error instanceof Error ? error.message : String(error)).replace(/\.$/, "");
}
