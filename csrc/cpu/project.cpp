// SPDX-License-Identifier: Apache-2.0
// From Gaussians to splats (EWA: Zwicker et al., 2001), and gradients back. Lanes are Gaussians.

#include <algorithm>
#include <cmath>

#include "block.h"
#include "mask.h"
#include "splat.h"
#include "vec.h"

namespace structgstream {
namespace SGS_ISA {
namespace {

constexpr float kLog2E = 1.44269504f;
constexpr float kBoxSlack = 0.01f;  // pixels
constexpr float kBlockSlack = 1e-4f;
constexpr float kFar = 1e7f;        // pixels: integers would overflow beyond it

// `Width` numbers of each Gaussian of a block as rows of lanes. Lanes beyond the end repeat the last Gaussian.
template <int Width>
struct Rows {
    alignas(kAlignment) float values[Width][kLanes];
    void read(const float* from, int64_t begin, int64_t count) {
        for (int l = 0; l < kLanes; ++l) {
            const float* row = from + Width * std::min(begin + l, count - 1);
            for (int j = 0; j < Width; ++j) values[j][l] = row[j];
        }
    }
    void write(int lane, float* to) const {
        for (int j = 0; j < Width; ++j) to[j] = values[j][lane];
    }
    vf operator[](int j) const { return load(values[j]); }
    void set(int j, vf value) { store(values[j], value); }
};

struct Block {
    Rows<3> means, scales;
    Rows<4> quats;
    void read(const GaussianInputs& in, int64_t begin, int64_t count) {
        means.read(in.means, begin, count);
        quats.read(in.quats, begin, count);
        scales.read(in.scales, begin, count);
    }
};

struct Rotation {
    vf w, x, y, z;   // unit length
    vf inverse;      // reciprocal of the length before normalisation
    vf r[9];
    explicit Rotation(const Rows<4>& q) {
        inverse = 1.0f / square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        w = q[0] * inverse, x = q[1] * inverse, y = q[2] * inverse, z = q[3] * inverse;
        r[0] = 1.0f - 2.0f * (y * y + z * z), r[1] = 2.0f * (x * y - w * z), r[2] = 2.0f * (x * z + w * y);
        r[3] = 2.0f * (x * y + w * z), r[4] = 1.0f - 2.0f * (x * x + z * z), r[5] = 2.0f * (y * z - w * x);
        r[6] = 2.0f * (x * z - w * y), r[7] = 2.0f * (y * z + w * x), r[8] = 1.0f - 2.0f * (x * x + y * y);
    }
};

// The scaled axes of a Gaussian as seen by the linearised camera: rows a (across) and b (down), three axes each.
struct Footprint {
    vf point[3];          // in camera coordinates
    vf inverse;           // reciprocal of its depth
    vf ux, uy;            // clamped x / z and y / z
    mask free_x, free_y;  // not clamped
    vf axes[9];           // view rotation * rotation * scales
    vf a[3], b[3];
    Footprint(const Pinhole& c, const Block& g, const Rotation& rotation) {
        for (int i = 0; i < 3; ++i) {
            const float* v = c.view + 4 * i;
            point[i] = v[0] * g.means[0] + v[1] * g.means[1] + v[2] * g.means[2] + v[3];
        }
        inverse = 1.0f / point[2];
        const vf x = point[0] * inverse, y = point[1] * inverse;
        ux = smallest(splat(c.right), largest(splat(-c.left), x));
        uy = smallest(splat(c.down), largest(splat(-c.up), y));
        free_x = both(at_least(x, splat(-c.left)), at_least(splat(c.right), x));
        free_y = both(at_least(y, splat(-c.up)), at_least(splat(c.down), y));
        const vf* r = rotation.r;
        for (int i = 0; i < 3; ++i) {
            const float* v = c.view + 4 * i;
            for (int j = 0; j < 3; ++j) axes[3 * i + j] = (v[0] * r[j] + v[1] * r[3 + j] + v[2] * r[6 + j]) * g.scales[j];
        }
        for (int j = 0; j < 3; ++j) {
            a[j] = c.fx * inverse * (axes[j] - ux * axes[6 + j]);
            b[j] = c.fy * inverse * (axes[3 + j] - uy * axes[6 + j]);
        }
    }
};

inline vi ceiling(vf x) {
    const vi towards_zero = __builtin_convertvector(x, vi);
    return towards_zero - (x > __builtin_convertvector(towards_zero, vf));  // true is minus one
}

inline vi floored(vf x) {
    const vi towards_zero = __builtin_convertvector(x, vi);
    return towards_zero + (x < __builtin_convertvector(towards_zero, vf));
}

inline vi at_most(vi a, int32_t limit) { return a < limit ? a : vi{} + limit; }
inline vi at_least_zero(vi a) { return a > 0 ? a : vi{}; }

bool reaches_drawn_tile(const Raster& raster, int x0, int y0, int x1, int y1) {
    if (raster.drawn_tiles.empty()) return true;
    for (int y = y0 / kTile; y <= (y1 - 1) / kTile; ++y)
        for (int x = x0 / kTile; x <= (x1 - 1) / kTile; ++x)
            if (raster.draws(y * raster.tiles_x + x)) return true;
    return false;
}

// Zero for finite numbers, else not a number.
template <int Width>
vf traces(const Rows<Width>& rows) {
    vf sum = splat(0.0f);
    for (int j = 0; j < Width; ++j) sum += rows[j] * 0.0f;
    return sum;
}

void project_block(const GaussianInputs& in, int64_t begin, Raster& raster, float* radii) {
    const Pinhole& c = raster.camera;
    Block g;
    g.read(in, begin, in.count);
    Rows<3> colors;
    Rows<1> opacities;
    colors.read(in.colors, begin, in.count);
    opacities.read(in.opacities, begin, in.count);
    vf opacity = opacities[0];
    vf finite = traces(g.means) + traces(g.quats) + traces(g.scales) + traces(colors) + opacity * 0.0f;
    const Rotation rotation(g.quats);
    const Footprint f(c, g, rotation);
    vf low_pass = splat(kLowPass);
    if (in.intervals) {  // reference_raster.screen_low_pass
        Rows<1> intervals;
        intervals.read(in.intervals, begin, in.count);
        finite += traces(intervals);
        const vf side = intervals[0] * f.inverse;
        low_pass *= c.fx * c.fy * side * side;
    }
    if (in.intervals) {
        // The determinant without low-pass is the square of a cross product, which does not cancel for needles.
        vf square = splat(0.0f), size = splat(0.0f);
        for (int j = 0; j < 3; ++j) {
            const int k = (j + 1) % 3, l = (j + 2) % 3;
            const vf normal = f.a[k] * f.b[l] - f.a[l] * f.b[k];
            square += normal * normal, size += f.a[j] * f.a[j] + f.b[j] * f.b[j];
        }
        const vf total = largest(low_pass, splat(kScreenLowPass));
        opacity *= square_root((square + low_pass * (size + low_pass)) / (square + total * (size + total)));
        low_pass = total;
    }
    vf xx = low_pass, xy = splat(0.0f), yy = low_pass;
    for (int j = 0; j < 3; ++j) xx += f.a[j] * f.a[j], xy += f.a[j] * f.b[j], yy += f.b[j] * f.b[j];
    const vf determinant = xx * yy - xy * xy;
    vf x = c.fx * f.point[0] * f.inverse + c.cx, y = c.fy * f.point[1] * f.inverse + c.cy;
    if (in.screen_offsets) {
        Rows<2> offsets;
        offsets.read(in.screen_offsets, begin, in.count);
        x += offsets[0], y += offsets[1];
    }
    // The exact box of alpha = 1/255, which shrinks with the opacity.
    const vf log2_opacity = log_two(largest(opacity, splat(kMinAlpha)));
    const vf reach = largest(splat(0.0f), log2_opacity - kLog2MinAlpha) * (2.0f / kLog2E);
    const vf half_x = square_root(reach * xx), half_y = square_root(reach * yy);
    mask seen = both(at_least(opacity, splat(kMinAlpha)), at_least(f.point[2], splat(c.near)));
    seen = both(seen, both(at_least(splat(0.0f), finite), above(determinant, splat(0.0f))));
    seen = both(seen, both(above(splat(kFar), half_x), above(splat(kFar), half_y)));
    seen = both(seen, both(above(splat(kFar), absolute(x)), above(splat(kFar), absolute(y))));
    seen = both(seen, both(above(x + half_x, splat(0.0f)), above(y + half_y, splat(0.0f))));
    seen = both(seen, both(above(splat(c.width), x - half_x), above(splat(c.height), y - half_y)));
    if (!any(seen)) {
        for (int l = 0; l < kLanes && begin + l < in.count; ++l) {
            Splat& s = raster.splats[begin + l];
            s.box[0] = s.box[1] = s.box[2] = s.box[3] = 0;
            radii[begin + l] = 0.0f;
        }
        return;
    }
    // Pixels whose centre is in the box, with slack for rounding. Lanes that are not visible may have any value.
    const auto tame = [&](vf value) { return keep(seen, value); };
    alignas(kAlignment) int32_t box[4][kLanes];
    store(box[0], at_least_zero(ceiling(tame(x - half_x) - (0.5f + kBoxSlack))));
    store(box[1], at_least_zero(ceiling(tame(y - half_y) - (0.5f + kBoxSlack))));
    store(box[2], at_most(floored(tame(x + half_x) + (0.5f + kBoxSlack)), c.width));
    store(box[3], at_most(floored(tame(y + half_y) + (0.5f + kBoxSlack)), c.height));
    alignas(kAlignment) float out[9][kLanes];
    const vf scale = (0.5f * kLog2E) / determinant;
    const vf to_x = yy * scale, to_xy = -2.0f * xy * scale, to_y = xx * scale;
    // Distance of a pixel's centre from its block's centre, for the triangle inequality.
    constexpr float kAside = 0.5f * (kBlockX - 1), kBelow = 0.5f * (kBlockY - 1);
    const vf within = square_root(largest(splat(0.0f), log2_opacity - kLog2MinAlpha)) +
                      square_root(kAside * kAside * to_x + kBelow * kBelow * to_y + kAside * kBelow * absolute(to_xy));
    const vf results[9] = {x, y, to_x, to_xy, to_y, log2_opacity, f.point[2], keep(seen, largest(half_x, half_y)),
                           within * within * (1.0f + kBlockSlack) + kBlockSlack};
    for (int j = 0; j < 9; ++j) store(out[j], results[j]);
    alignas(kAlignment) float live[kLanes];
    store(live, keep(seen, splat(1.0f)));
    for (int l = 0; l < kLanes && begin + l < in.count; ++l) {
        Splat& s = raster.splats[begin + l];
        s.box[0] = s.box[1] = s.box[2] = s.box[3] = 0;
        radii[begin + l] = 0.0f;
        if (live[l] == 0.0f) continue;
        const bool between_centres = box[0][l] >= box[2][l] || box[1][l] >= box[3][l];
        if (!between_centres && !reaches_drawn_tile(raster, box[0][l], box[1][l], box[2][l], box[3][l])) continue;
        radii[begin + l] = out[7][l];
        if (between_centres) continue;
        s.x = out[0][l], s.y = out[1][l], s.xx = out[2][l], s.xy = out[3][l], s.yy = out[4][l];
        s.log2_opacity = out[5][l], s.depth = out[6][l], s.near_block = out[8][l];
        colors.write(l, s.color);
        for (int j = 0; j < 4; ++j) s.box[j] = box[j][l];
    }
}

void write_zeros(int64_t i, const GaussianGradients& out) {
    std::fill_n(out.means + 3 * i, 3, 0.0f);
    std::fill_n(out.quats + 4 * i, 4, 0.0f);
    std::fill_n(out.scales + 3 * i, 3, 0.0f);
    std::fill_n(out.colors + 3 * i, 3, 0.0f);
    out.opacities[i] = 0.0f;
    if (out.screen_offsets) std::fill_n(out.screen_offsets + 2 * i, 2, 0.0f);
}

void project_block_backward(
    const GaussianInputs& in, int64_t begin, const Raster& raster, const float* moments, const GaussianGradients& out) {
    const Pinhole& c = raster.camera;
    Rows<kMomentCount> sums;
    Rows<3> conics;
    bool drawn[kLanes], none = true;
    const int lanes = static_cast<int>(std::min<int64_t>(kLanes, in.count - begin));
    for (int l = 0; l < kLanes; ++l) {
        const int64_t i = begin + l;
        drawn[l] = i < raster.trained && raster.splats[i].box[0] < raster.splats[i].box[2];
        float m[kMomentCount] = {};
        if (drawn[l]) {
            none = false;
            for (int64_t slot = raster.slots[i]; slot < raster.slots[i + 1]; ++slot)
                for (int j = 0; j < kMomentCount; ++j) m[j] += moments[slot * kMomentCount + j];
        }
        for (int j = 0; j < kMomentCount; ++j) sums.values[j][l] = m[j];
        const Splat& s = raster.splats[std::min(i, in.count - 1)];
        conics.values[0][l] = s.xx, conics.values[1][l] = s.xy, conics.values[2][l] = s.yy;
    }
    if (none) {
        for (int l = 0; l < lanes; ++l) write_zeros(begin + l, out);
        return;
    }
    Block g;
    g.read(in, begin, in.count);
    // power = -(A dx^2 + 2 B dx dy + C dy^2) / 2 with dx = pixel - mean.
    const vf A = conics[0] * (2.0f / kLog2E), B = conics[1] * (1.0f / kLog2E), C = conics[2] * (2.0f / kLog2E);
    const vf gx = A * sums[1] + B * sums[2], gy = B * sums[1] + C * sums[2];
    // dL/dcovariance = -Q G Q with Q the conic and G = dL/dQ.
    const vf g00 = -0.5f * sums[3], g01 = -0.5f * sums[4], g11 = -0.5f * sums[5];
    const vf p00 = A * g00 + B * g01, p01 = A * g01 + B * g11, p10 = B * g00 + C * g01, p11 = B * g01 + C * g11;
    const vf d00 = -(p00 * A + p01 * B), d01 = -(p00 * B + p01 * C), d11 = -(p10 * B + p11 * C);

    const Rotation rotation(g.quats);
    const Footprint f(c, g, rotation);
    vf axes[9], dux = splat(0.0f), duy = splat(0.0f), dz = splat(0.0f);
    for (int j = 0; j < 3; ++j) {
        const vf da = 2.0f * (d00 * f.a[j] + d01 * f.b[j]), db = 2.0f * (d11 * f.b[j] + d01 * f.a[j]);
        const vf ka = c.fx * f.inverse * da, kb = c.fy * f.inverse * db;
        axes[j] = ka, axes[3 + j] = kb, axes[6 + j] = -f.ux * ka - f.uy * kb;
        dux -= ka * f.axes[6 + j], duy -= kb * f.axes[6 + j];
        dz -= (da * f.a[j] + db * f.b[j]) * f.inverse;
    }
    // The projected mean always follows the point; the linearisation only where it is not clamped.
    vf point[3] = {gx * c.fx * f.inverse, gy * c.fy * f.inverse, dz};
    point[2] -= (gx * c.fx * f.point[0] + gy * c.fy * f.point[1]) * f.inverse * f.inverse;
    const vf along_x = keep(f.free_x, dux * f.inverse), along_y = keep(f.free_y, duy * f.inverse);
    point[0] += along_x, point[1] += along_y;
    point[2] -= along_x * f.ux + along_y * f.uy;

    Rows<3> means, scales;
    Rows<4> quats;
    Rows<2> offsets;
    for (int j = 0; j < 3; ++j)
        means.set(j, c.view[j] * point[0] + c.view[4 + j] * point[1] + c.view[8 + j] * point[2]);
    vf dr[9];
    for (int j = 0; j < 3; ++j) {
        vf ds = splat(0.0f);
        for (int k = 0; k < 3; ++k) {
            const vf world = c.view[k] * axes[j] + c.view[4 + k] * axes[3 + j] + c.view[8 + k] * axes[6 + j];
            ds += world * rotation.r[3 * k + j];
            dr[3 * k + j] = world * g.scales[j];
        }
        scales.set(j, ds);
    }
    const vf w = rotation.w, x = rotation.x, y = rotation.y, z = rotation.z;
    const vf dq[4] = {
        2.0f * (z * (dr[3] - dr[1]) + y * (dr[2] - dr[6]) + x * (dr[7] - dr[5])),
        2.0f * (y * (dr[1] + dr[3]) + z * (dr[2] + dr[6]) + w * (dr[7] - dr[5]) - 2.0f * x * (dr[4] + dr[8])),
        2.0f * (x * (dr[1] + dr[3]) + z * (dr[5] + dr[7]) + w * (dr[2] - dr[6]) - 2.0f * y * (dr[0] + dr[8])),
        2.0f * (x * (dr[2] + dr[6]) + y * (dr[5] + dr[7]) + w * (dr[3] - dr[1]) - 2.0f * z * (dr[0] + dr[4]))};
    const vf along = dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z;
    const vf unit[4] = {w, x, y, z};
    for (int j = 0; j < 4; ++j) quats.set(j, rotation.inverse * (dq[j] - along * unit[j]));
    offsets.set(0, gx), offsets.set(1, gy);
    for (int l = 0; l < lanes; ++l) {
        const int64_t i = begin + l;
        if (!drawn[l]) {
            write_zeros(i, out);
            continue;
        }
        means.write(l, out.means + 3 * i);
        scales.write(l, out.scales + 3 * i);
        quats.write(l, out.quats + 4 * i);
        if (out.screen_offsets) offsets.write(l, out.screen_offsets + 2 * i);
        out.opacities[i] = sums.values[0][l] / in.opacities[i];
        for (int j = 0; j < 3; ++j) out.colors[3 * i + j] = sums.values[6 + j][l];
    }
}

}  // namespace

void project(const GaussianInputs& in, Raster& raster, float* radii, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t begin = 0; begin < in.count; begin += kLanes) project_block(in, begin, raster, radii);
}

// moments: kMomentCount numbers a pair, in the slots of each splat.
void project_backward(
    const GaussianInputs& in, const Raster& raster, const float* moments, const GaussianGradients& out, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t begin = 0; begin < in.count; begin += kLanes)
        project_block_backward(in, begin, raster, moments, out);
}

}  // namespace SGS_ISA
}  // namespace structgstream
