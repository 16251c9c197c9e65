// SPDX-License-Identifier: Apache-2.0

import type { FieldName, Tensor } from "@structgstream/core";
import { expect, test } from "vitest";
import { mlpLayout, packedWeights, paddedRows } from "../src/gpu/weights.ts";
import { shapeOf } from "../src/scene.ts";
import { cornerIndices, INDICES_PER_SPLAT, SPLATS_PER_CALL } from "../src/shaders/splat.ts";

const [D, R, K, H] = [5, 2, 2, 6];

function tensor(shape: number[], salt: number): Tensor {
  const count = shape.reduce((product, size) => product * size, 1);
  return { shape, data: Float32Array.from({ length: count }, (_, i) => Math.sin(i * 1.7 + salt)) };
}

function fields(): Map<FieldName, Tensor> {
  const head = (outputs: number, salt: number) => tensor([H * (D + 4 + 1) + outputs * K * (H + 1)], salt);
  return new Map<FieldName, Tensor>([
    ["anchor_offsets", tensor([3, K, 3], 1)],
    ["anchor_features", tensor([3, D], 2)],
    ["appearance", tensor([3, R], 3)],
    ["appearance_basis", tensor([R, D], 4)],
    ["opacity_mlp", head(1, 5)],
    ["color_mlp", head(3, 6)],
    ["covariance_mlp", head(7, 7)],
    ["free", tensor([0, 14], 8)],
  ]);
}

test("packed weights give what the MLP gives, with appearance as an input of its own", () => {
  const scene = fields();
  const shape = shapeOf(scene, true);
  expect(shape).toEqual({ offsetsPerAnchor: K, features: D, appearance: R, hidden: H, distanceInput: true });
  const layout = mlpLayout(shape);
  const packed = packedWeights(scene, shape);
  const data = (name: FieldName) => scene.get(name)!.data as Float32Array;
  const seen = [0.6, 0, -0.8, 2.5];
  const [features, appearance] = [data("anchor_features").subarray(0, D), data("appearance").subarray(0, R)];
  const changed = [...features].map(
    (x, i) => x + appearance.reduce((s, a, r) => s + a * data("appearance_basis")[r * D + i]!, 0),
  );
  const inputs = [...changed, ...seen];
  const given = [...paddedRows(features, D), ...paddedRows(appearance, R), ...seen];
  expect(given.length).toBe(4 * layout.inputTexels);
  for (const [head, field, outputs] of [
    ["opacity", "opacity_mlp", K],
    ["color", "color_mlp", 3 * K],
    ["covariance", "covariance_mlp", 7 * K],
  ] as const) {
    const w = data(field);
    const n = inputs.length;
    const hidden = Array.from({ length: H }, (_, j) =>
      Math.max(
        inputs.reduce((sum, x, i) => sum + x * w[j * n + i]!, w[H * n + j]!),
        0,
      ),
    );
    const texel = (i: number) => packed.subarray(4 * (layout.heads[head] + i), 4 * (layout.heads[head] + i) + 4);
    const units = Array.from({ length: 4 * layout.hiddenTexels }, (_, j) => {
      const at = (j >> 2) * (4 * layout.inputTexels + 1);
      let sum = texel(at + 4 * layout.inputTexels)[j & 3]!;
      given.forEach((x, i) => {
        sum += x * texel(at + (j & 3) * layout.inputTexels + (i >> 2))[i & 3]!;
      });
      return Math.max(sum, 0);
    });
    for (let o = 0; o < outputs; o++) {
      const at = layout.outputsAt + o * layout.outputTexels;
      const found = units.reduce(
        (sum, u, j) => sum + u * texel(at + (j >> 2))[j & 3]!,
        texel(at + layout.hiddenTexels)[0]!,
      );
      const row = H * n + H + o * H;
      const wanted = hidden.reduce((sum, u, j) => sum + u * w[row + j]!, w[H * n + H + outputs * H + o]!);
      expect(found).toBeCloseTo(wanted, 5);
    }
  }
  expect(packed.length).toBe(4 * layout.texels);
});

test("no corner of a splat has the index that begins a new primitive", () => {
  const indices = cornerIndices();
  expect(indices.length).toBe(INDICES_PER_SPLAT * SPLATS_PER_CALL);
  expect(indices.includes(0xffff)).toBe(false);
  expect([...indices.slice(-INDICES_PER_SPLAT)].map((index) => index - 4 * (SPLATS_PER_CALL - 1))).toEqual([
    0, 1, 2, 2, 1, 3,
  ]);
});
