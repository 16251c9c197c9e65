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

export class Resources {
  private readonly textures = new Set<WebGLTexture>();
  private readonly buffers = new Set<WebGLBuffer>();
  private readonly programs = new Set<WebGLProgram>();
  private readonly framebuffers = new Set<WebGLFramebuffer>();
  private readonly feedbacks = new Set<WebGLTransformFeedback>();
  private readonly arrays = new Set<WebGLVertexArrayObject>();

  constructor(readonly gl: WebGL2RenderingContext) {}

  get counts(): Omit<ResourceCounts, "workers"> {
    return {
      textures: this.textures.size,
      buffers: this.buffers.size + this.feedbacks.size + this.arrays.size,
      programs: this.programs.size,
      framebuffers: this.framebuffers.size,
    };
  }

  texture(): WebGLTexture {
    return kept(this.textures, this.gl.createTexture());
  }

  buffer(): WebGLBuffer {
    return kept(this.buffers, this.gl.createBuffer());
  }

  framebuffer(): WebGLFramebuffer {
    return kept(this.framebuffers, this.gl.createFramebuffer());
  }

  feedback(): WebGLTransformFeedback {
    return kept(this.feedbacks, this.gl.createTransformFeedback());
  }

  vertexArray(): WebGLVertexArrayObject {
    return kept(this.arrays, this.gl.createVertexArray());
  }

  /** @throws GlError the driver rejects the program; a lost context returns one that does nothing */
  program(source: ProgramSource): Program {
    const { gl } = this;
    const handle = kept(this.programs, gl.createProgram());
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

  deleteTexture(texture: WebGLTexture): void {
    if (this.textures.delete(texture)) this.gl.deleteTexture(texture);
  }

  deleteBuffer(buffer: WebGLBuffer): void {
    if (this.buffers.delete(buffer)) this.gl.deleteBuffer(buffer);
  }

  deleteProgram(program: WebGLProgram): void {
    if (this.programs.delete(program)) this.gl.deleteProgram(program);
  }

  deleteAll(): void {
    const { gl } = this;
    for (const texture of this.textures) gl.deleteTexture(texture);
    for (const buffer of this.buffers) gl.deleteBuffer(buffer);
    for (const program of this.programs) gl.deleteProgram(program);
    for (const framebuffer of this.framebuffers) gl.deleteFramebuffer(framebuffer);
    for (const feedback of this.feedbacks) gl.deleteTransformFeedback(feedback);
    for (const array of this.arrays) gl.deleteVertexArray(array);
    for (const set of [this.textures, this.buffers, this.programs, this.framebuffers, this.feedbacks, this.arrays]) {
      set.clear();
    }
  }
}

/** A lost context may return null, and ignores it as an argument. */
function kept<T>(set: Set<T>, made: T | null): T {
  if (made !== null) set.add(made);
  return made as T;
}

function refused(log: string | null): GlError {
  const reason = (log ?? "").split("\n")[0]?.replaceAll("\0", "").trim() || "without a reason";
  return new GlError(`The graphics driver refuses a shader (${reason}); update it, or try another browser.`);
}
