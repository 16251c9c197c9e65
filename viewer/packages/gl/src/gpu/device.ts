// SPDX-License-Identifier: Apache-2.0
/** The context, and the capabilities of this device. */

import { GlError } from "../errors.js";
import type { MlpPath } from "../types.js";

/** vec4s of the MLPs' outputs per splat. */
export const SPLAT_VECTORS = 3;
/** Number of targets of four 32-bit numbers that two splats' outputs fill as half floats. */
export const PAIR_TARGETS = 3;

export interface Device {
  readonly gl: WebGL2RenderingContext;
  /** Format of the texture into which splats are blended; in 8 bits soft gradients may show steps. */
  readonly blendFormat: "RGBA16F" | "RGBA8";
  readonly maxTextureSize: number;
  readonly maxLayers: number;
  /** Splats of an anchor that one pass can compute, by path; 0 if the device does not support the path. */
  readonly splatsPerPass: Readonly<Record<MlpPath, number>>;
}

/** @throws GlError this browser or device has no WebGL2 */
export function openDevice(canvas: HTMLCanvasElement | OffscreenCanvas): Device {
  const gl = canvas.getContext("webgl2", {
    alpha: false,
    antialias: false,
    depth: false,
    stencil: false,
    powerPreference: "high-performance",
  }) as WebGL2RenderingContext | null;
  if (!gl) {
    throw new GlError(
      "This browser does not support WebGL2, which the player needs; turn on hardware acceleration, or use a current browser.",
    );
  }
  return deviceOf(gl);
}

/** Capabilities of a context; called again after a context was restored, because extensions must be enabled again. */
export function deviceOf(gl: WebGL2RenderingContext): Device {
  const float = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
  return {
    gl,
    blendFormat: float ? "RGBA16F" : "RGBA8",
    maxTextureSize: limit(gl, gl.MAX_TEXTURE_SIZE),
    maxLayers: limit(gl, gl.MAX_ARRAY_TEXTURE_LAYERS),
    splatsPerPass: {
      "transform-feedback": Math.floor(
        Math.min(
          limit(gl, gl.MAX_TRANSFORM_FEEDBACK_INTERLEAVED_COMPONENTS) / 4,
          limit(gl, gl.MAX_VERTEX_OUTPUT_COMPONENTS) / 4 - 1,
          limit(gl, gl.MAX_VARYING_VECTORS),
        ) / SPLAT_VECTORS,
      ),
      mrt: 2 * Math.floor(Math.min(limit(gl, gl.MAX_DRAW_BUFFERS), limit(gl, gl.MAX_COLOR_ATTACHMENTS)) / PAIR_TARGETS),
    },
  };
}

/**
 * The requested path, or the best that the device supports.
 *
 * @throws GlError the device does not support the requested path
 */
export function chosenPath(device: Device, asked: MlpPath | undefined): MlpPath {
  const { splatsPerPass } = device;
  const path = asked ?? (splatsPerPass["transform-feedback"] > 0 ? "transform-feedback" : "mrt");
  if (splatsPerPass[path] > 0) return path;
  const other = path === "mrt" ? "transform-feedback" : "mrt";
  throw new GlError(
    `This device's limits are too small for the MLP path ${JSON.stringify(path)}; expected at least ` +
      `${PAIR_TARGETS} draw buffers or ${4 * SPLAT_VECTORS} transform feedback components; try ${JSON.stringify(other)}.`,
  );
}

function limit(gl: WebGL2RenderingContext, name: number): number {
  // A context that is lost at this moment returns null and is queried again later.
  return (gl.getParameter(name) as number | null) ?? 0;
}
