// SPDX-License-Identifier: Apache-2.0
/** Symmetric 3x3 matrices: eigenvectors by Jacobi's rotations. */

import type { Vector } from "./vectors.js";

export type Symmetric = readonly [Vector, Vector, Vector];

const SWEEPS = 24;

/** Eigenvalues, ascending, each with its unit eigenvector. */
export function eigen(matrix: Symmetric): readonly { readonly value: number; readonly vector: Vector }[] {
  const a = matrix.map((row) => [...row]);
  const v = [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ];
  for (let sweep = 0; sweep < SWEEPS; sweep++) {
    for (const [p, q] of [
      [0, 1],
      [0, 2],
      [1, 2],
    ] as const) {
      const off = a[p]![q]!;
      if (off === 0) continue;
      const theta = (a[q]![q]! - a[p]![p]!) / (2 * off);
      const t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.sqrt(theta * theta + 1));
      const c = 1 / Math.sqrt(t * t + 1);
      const s = t * c;
      for (let i = 0; i < 3; i++) turn(a[i]!, p, q, c, s);
      const [rowP, rowQ] = [[...a[p]!], [...a[q]!]];
      for (let i = 0; i < 3; i++) {
        a[p]![i] = c * rowP[i]! - s * rowQ[i]!;
        a[q]![i] = s * rowP[i]! + c * rowQ[i]!;
      }
      for (let i = 0; i < 3; i++) turn(v[i]!, p, q, c, s);
    }
  }
  return [0, 1, 2]
    .map((i) => ({ value: a[i]![i]!, vector: [v[0]![i]!, v[1]![i]!, v[2]![i]!] as Vector }))
    .sort((first, second) => first.value - second.value);
}

/** The sum of `u u^T` over the vectors. */
export function outerSum(vectors: readonly Vector[]): Symmetric {
  const sum = (i: number, j: number) => vectors.reduce((total, vector) => total + vector[i]! * vector[j]!, 0);
  const [xy, xz, yz] = [sum(0, 1), sum(0, 2), sum(1, 2)];
  return [
    [sum(0, 0), xy, xz],
    [xy, sum(1, 1), yz],
    [xz, yz, sum(2, 2)],
  ];
}

function turn(row: number[], p: number, q: number, c: number, s: number): void {
  const [x, y] = [row[p]!, row[q]!];
  row[p] = c * x - s * y;
  row[q] = s * x + c * y;
}
