// SPDX-License-Identifier: Apache-2.0
/** Counts what exists on the GPU; imported before anything that draws. */

const KINDS = ["Texture", "Buffer", "Framebuffer", "Renderbuffer", "VertexArray", "Program", "Shader"] as const;
const living: Record<string, Set<unknown>> = Object.fromEntries(KINDS.map((kind) => [kind, new Set()]));
const prototype = WebGL2RenderingContext.prototype as unknown as Record<string, (...values: unknown[]) => unknown>;

for (const kind of KINDS) {
  const [created, deleted] = [prototype[`create${kind}`]!, prototype[`delete${kind}`]!];
  prototype[`create${kind}`] = function (...values) {
    const made = created.apply(this, values);
    living[kind]!.add(made);
    return made;
  };
  prototype[`delete${kind}`] = function (...values) {
    living[kind]!.delete(values[0]);
    return deleted.apply(this, values);
  };
}

/** Numbers of textures, buffers and so on of all contexts that were not deleted. */
export function glCounts(): Record<string, number> {
  return Object.fromEntries(KINDS.map((kind) => [kind, living[kind]!.size]));
}
