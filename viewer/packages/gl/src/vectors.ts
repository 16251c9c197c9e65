// SPDX-License-Identifier: Apache-2.0
/** Vectors of three numbers, rotations as three rows, and unit quaternions (wxyz). */

export type Vector = readonly [number, number, number];
export type Rotation = readonly [Vector, Vector, Vector];
export type Quaternion = readonly [number, number, number, number];

export function dot(a: Vector, b: Vector): number {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

export function cross(a: Vector, b: Vector): Vector {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** `a + factor * b` */
export function along(a: Vector, b: Vector, factor = 1): Vector {
  return [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
}

export function scaled(a: Vector, factor: number): Vector {
  return [a[0] * factor, a[1] * factor, a[2] * factor];
}

export function length(a: Vector): number {
  return Math.hypot(a[0], a[1], a[2]);
}

/** The vector scaled to length 1; a zero vector is unchanged. */
export function unit(a: Vector): Vector {
  const size = length(a);
  return size > 0 ? scaled(a, 1 / size) : a;
}

export function mean(vectors: readonly Vector[]): Vector {
  const sum = vectors.reduce((total, vector) => along(total, vector), [0, 0, 0] as Vector);
  return scaled(sum, 1 / Math.max(vectors.length, 1));
}

/** A unit vector perpendicular to `a`. */
export function across(a: Vector): Vector {
  const smallest: Vector = Math.abs(a[0]) < 0.6 * length(a) ? [1, 0, 0] : [0, 1, 0];
  return unit(cross(a, smallest));
}

export function quaternionOf(r: Rotation): Quaternion {
  // The largest component is computed first, because dividing by a small one would lose precision.
  const [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = r;
  const squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz];
  const largest = squares.indexOf(Math.max(...squares));
  const half = Math.sqrt(Math.max(squares[largest]!, 0));
  const f = 0.5 / half;
  const [x, y, z] = [(zy - yz) * f, (xz - zx) * f, (yx - xy) * f];
  const [a, b, c] = [(xy + yx) * f, (yz + zy) * f, (zx + xz) * f];
  if (largest === 0) return [half / 2, x, y, z];
  if (largest === 1) return [x, half / 2, a, c];
  if (largest === 2) return [y, a, half / 2, b];
  return [z, c, b, half / 2];
}

export function rotationOf([w, x, y, z]: Quaternion): Rotation {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/** Interpolated rotation at `share` of the shorter way from one to the other. */
export function rotationBetween(from: Rotation, to: Rotation, share: number): Rotation {
  const a = quaternionOf(from);
  let b = quaternionOf(to);
  let cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  if (cosine < 0) {
    b = [-b[0], -b[1], -b[2], -b[3]];
    cosine = -cosine;
  }
  const angle = Math.acos(Math.min(cosine, 1));
  const sine = Math.sin(angle);
  const [p, q] =
    sine < 1e-6 ? [1 - share, share] : [Math.sin((1 - share) * angle) / sine, Math.sin(share * angle) / sine];
  const mixed: Quaternion = [p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2], p * a[3] + q * b[3]];
  const size = Math.hypot(...mixed);
  return rotationOf([mixed[0] / size, mixed[1] / size, mixed[2] / size, mixed[3] / size]);
}

/** The unit vector that is `share` of the way from the direction of one to that of the other. */
export function directionBetween(from: Vector, to: Vector, share: number): Vector {
  const [a, b] = [unit(from), unit(to)];
  const angle = Math.acos(Math.min(Math.max(dot(a, b), -1), 1));
  if (angle < 1e-6) return a;
  if (Math.PI - angle < 1e-6) {
    // Opposite directions: any plane is correct.
    const side = across(a);
    return along(scaled(a, Math.cos(share * angle)), side, Math.sin(share * angle));
  }
  const sine = Math.sin(angle);
  return unit(along(scaled(a, Math.sin((1 - share) * angle) / sine), b, Math.sin(share * angle) / sine));
}
