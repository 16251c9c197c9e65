// SPDX-License-Identifier: Apache-2.0
/** All resources of a context, so that they can be counted and released. */

import { GlError } from "../errors.js";
import type { ResourceCounts } from "../types.js";

/** The common head of all shaders. */
const HEAD = `#version 300 es
${["float", "int", "sampler2D", "usampler2D", "usampler2DArray"].map((type) => `precision highp ${type};\n`).join("")}`;

export interface ProgramSource {
  readonly vertex: string;
  readonly fragment: string;
  /** Outputs of the vertex shader that transform feedback writes, interleaved. */
  readonly feedback?: readonly string[];
}

/** A linked program and the locations of its uniforms. */
export class Program {
  private readonly places = new Map<string, WebGLUniformLocation | null>();

  constructor(
    private readonly gl: WebGL2RenderingContext,
    readonly handle: WebGLProgram,
  ) {}

  /** Location of a uniform; null, which WebGL ignores, if the compiler removed it as unused. */
  at(name: string): WebGLUniformLocation | null {
    let place = this.places.get(name);
    if (place === undefined) {
      place = this.gl.getUniformLocation(this.handle, name);
      this.places.set(name, place);
    }
    return place;
  }
}

type Kind = Exclude<keyof ResourceCounts, "workers">;

export class Resources {
  /** Each resource, its kind and how it is deleted. */
  private readonly living = new Map<object, readonly [kind: Kind, free: () => void]>();

  constructor(readonly gl: WebGL2RenderingContext) {}

  get counts(): Record<Kind, number> {
    const counts = { textures: 0, buffers: 0, programs: 0, framebuffers: 0 };
    for (const [kind] of this.living.values()) counts[kind]++;
    return counts;
  }

  texture(): WebGLTexture {
    return this.kept("textures", this.gl.createTexture(), (made) => this.gl.deleteTexture(made));
  }

  buffer(): WebGLBuffer {
    return this.kept("buffers", this.gl.createBuffer(), (made) => this.gl.deleteBuffer(made));
  }

  framebuffer(): WebGLFramebuffer {
    return this.kept("framebuffers", this.gl.createFramebuffer(), (made) => this.gl.deleteFramebuffer(made));
  }

  feedback(): WebGLTransformFeedback {
    return this.kept("buffers", this.gl.createTransformFeedback(), (made) => this.gl.deleteTransformFeedback(made));
  }

  vertexArray(): WebGLVertexArrayObject {
    return this.kept("buffers", this.gl.createVertexArray(), (made) => this.gl.deleteVertexArray(made));
  }

  /** @throws GlError the driver rejects the program; a lost context returns one that does nothing */
  program(source: ProgramSource): Program {
    const { gl } = this;
    const handle = this.kept("programs", gl.createProgram(), (made) => gl.deleteProgram(made));
    for (const [type, text] of [
      [gl.VERTEX_SHADER, source.vertex],
      [gl.FRAGMENT_SHADER, source.fragment],
    ] as const) {
      const shader = gl.createShader(type);
      if (!shader) continue; // only a lost context returns none
      gl.shaderSource(shader, HEAD + text);
      gl.compileShader(shader);
      gl.attachShader(handle, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw refused(gl.getShaderInfoLog(shader));
      }
      gl.deleteShader(shader);
    }
    if (source.feedback) gl.transformFeedbackVaryings(handle, [...source.feedback], gl.INTERLEAVED_ATTRIBS);
    gl.linkProgram(handle);
    if (!gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw refused(gl.getProgramInfoLog(handle));
    }
    return new Program(gl, handle);
  }

  delete(resource: object): void {
    this.living.get(resource)?.[1]();
    this.living.delete(resource);
  }

  deleteAll(): void {
    for (const resource of this.living.keys()) this.delete(resource);
  }

  /** A lost context may return null, and ignores it as an argument. */
  private kept<Resource extends object>(kind: Kind, made: Resource | null, free: (made: Resource) => void): Resource {
    if (made !== null) this.living.set(made, [kind, () => free(made)]);
    return made as Resource;
  }
}

function refused(log: string | null): GlError {
  const reason = (log ?? "").split("\n")[0]?.replaceAll("\0", "").trim() || "without a reason";
  return new GlError(`The graphics driver refuses a shader (${reason}); update it, or try another browser.`);
}
