// SPDX-License-Identifier: Apache-2.0
// Gaussians to splats (EWA: Zwicker et al., 2001) and the gradients back. One Gaussian at a time; the compiler sees
// independent iterations.

#include <algorithm>
#include <cmath>

#include "splat.h"

#ifndef SGS_ISA
#define SGS_ISA native
#endif

namespace structgstream {
namespace SGS_ISA {
namespace {

constexpr float kLog2E = 1.44269504f;
constexpr float kBoxSlack = 0.01f;  // pixels

void rotation(const float* q, float* r) {
    const float s = 1.0f / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const float w = q[0] * s, x = q[1] * s, y = q[2] * s, z = q[3] * s;
    r[0] = 1 - 2 * (y * y + z * z), r[1] = 2 * (x * y - w * z), r[2] = 2 * (x * z + w * y);
    r[3] = 2 * (x * y + w * z), r[4] = 1 - 2 * (x * x + z * z), r[5] = 2 * (y * z - w * x);
    r[6] = 2 * (x * z - w * y), r[7] = 2 * (y * z + w * x), r[8] = 1 - 2 * (x * x + y * y);
}

// The scaled axes of a Gaussian as seen by the linearised camera: rows a (across) and b (down), three axes each.
struct Footprint {
    float point[3];          // in the camera
    float ux, uy;            // clamped x / z and y / z
    bool free_x, free_y;     // not clamped
    float axes[9];           // view rotation * rotation * scales
    float a[3], b[3];
};

Footprint footprint(const Pinhole& c, const float* mean, const float* quat, const float* scale) {
    Footprint f;
    for (int i = 0; i < 3; ++i)
        f.point[i] = c.view[4 * i] * mean[0] + c.view[4 * i + 1] * mean[1] + c.view[4 * i + 2] * mean[2] + c.view[4 * i + 3];
    const float inverse = 1.0f / f.point[2];
    const float x = f.point[0] * inverse, y = f.point[1] * inverse;
    f.ux = std::min(c.right, std::max(-c.left, x)), f.uy = std::min(c.down, std::max(-c.up, y));
    f.free_x = f.ux == x, f.free_y = f.uy == y;
    float r[9];
    rotation(quat, r);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            f.axes[3 * i + j] =
                (c.view[4 * i] * r[j] + c.view[4 * i + 1] * r[3 + j] + c.view[4 * i + 2] * r[6 + j]) * scale[j];
    for (int j = 0; j < 3; ++j) {
        f.a[j] = c.fx * inverse * (f.axes[j] - f.ux * f.axes[6 + j]);
        f.b[j] = c.fy * inverse * (f.axes[3 + j] - f.uy * f.axes[6 + j]);
    }
    return f;
}

bool finite(const GaussianInputs& in, int64_t i) {
    float sum = in.opacities[i];
    for (int j = 0; j < 3; ++j)
        sum += in.means[3 * i + j] * 0.0f + in.scales[3 * i + j] * 0.0f + in.colors[3 * i + j] * 0.0f;
    for (int j = 0; j < 4; ++j) sum += in.quats[4 * i + j] * 0.0f;
    return std::isfinite(sum);
}

bool reaches_drawn_tile(const Raster& raster, int x0, int y0, int x1, int y1) {
    if (raster.drawn_tiles.empty()) return true;
    for (int y = y0 / kTile; y <= (y1 - 1) / kTile; ++y)
        for (int x = x0 / kTile; x <= (x1 - 1) / kTile; ++x)
            if (raster.draws(y * raster.tiles_x + x)) return true;
    return false;
}

}  // namespace

void project(const GaussianInputs& in, Raster& raster, float* radii, int threads) {
    const Pinhole& c = raster.camera;
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t i = 0; i < in.count; ++i) {
        Splat& s = raster.splats[i];
        s.box[0] = s.box[1] = s.box[2] = s.box[3] = 0;
        radii[i] = 0.0f;
        const float opacity = in.opacities[i];
        if (!finite(in, i) || !(opacity >= kMinAlpha)) continue;
        const Footprint f = footprint(c, in.means + 3 * i, in.quats + 4 * i, in.scales + 3 * i);
        if (!(f.point[2] >= c.near)) continue;
        const float xx = f.a[0] * f.a[0] + f.a[1] * f.a[1] + f.a[2] * f.a[2] + kLowPass;
        const float xy = f.a[0] * f.b[0] + f.a[1] * f.b[1] + f.a[2] * f.b[2];
        const float yy = f.b[0] * f.b[0] + f.b[1] * f.b[1] + f.b[2] * f.b[2] + kLowPass;
        const float determinant = xx * yy - xy * xy;
        if (!(determinant > 0.0f)) continue;
        s.x = c.fx * f.point[0] / f.point[2] + c.cx, s.y = c.fy * f.point[1] / f.point[2] + c.cy;
        if (in.screen_offsets) s.x += in.screen_offsets[2 * i], s.y += in.screen_offsets[2 * i + 1];
        // The exact box of alpha = 1/255: it shrinks with the opacity.
        const float log2_opacity = std::log2(opacity);
        const float reach = std::max(0.0f, log2_opacity - kLog2MinAlpha) * (2.0f / kLog2E);
        const float half_x = std::sqrt(reach * xx), half_y = std::sqrt(reach * yy);
        if (!(half_x < 1e7f && half_y < 1e7f && std::fabs(s.x) < 1e7f && std::fabs(s.y) < 1e7f)) continue;
        if (s.x + half_x <= 0.0f || s.y + half_y <= 0.0f || s.x - half_x >= c.width || s.y - half_y >= c.height) continue;
        // Pixels whose centre is in the box, with slack for roundings.
        const int x0 = std::max(0, static_cast<int>(std::ceil(s.x - half_x - 0.5f - kBoxSlack)));
        const int y0 = std::max(0, static_cast<int>(std::ceil(s.y - half_y - 0.5f - kBoxSlack)));
        const int x1 = std::min(c.width, static_cast<int>(std::floor(s.x + half_x + 0.5f + kBoxSlack)));
        const int y1 = std::min(c.height, static_cast<int>(std::floor(s.y + half_y + 0.5f + kBoxSlack)));
        const bool between_centres = x0 >= x1 || y0 >= y1;
        if (!between_centres && !reaches_drawn_tile(raster, x0, y0, x1, y1)) continue;
        radii[i] = std::max(half_x, half_y);
        if (between_centres) continue;
        const float scale = 0.5f * kLog2E / determinant;
        s.xx = yy * scale, s.xy = -2.0f * xy * scale, s.yy = xx * scale;
        s.log2_opacity = log2_opacity;
        for (int j = 0; j < 3; ++j) s.color[j] = in.colors[3 * i + j];
        s.depth = f.point[2];
        s.box[0] = x0, s.box[1] = y0, s.box[2] = x1, s.box[3] = y1;
    }
}

// moments: kMomentCount numbers a pair, in the slots of each splat.
void project_backward(
    const GaussianInputs& in, const Raster& raster, const float* moments, const GaussianGradients& out, int threads) {
    const Pinhole& c = raster.camera;
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t i = 0; i < raster.trained; ++i) {
        const Splat& s = raster.splats[i];
        if (s.box[0] >= s.box[2]) continue;
        float m[kMomentCount] = {};
        for (int64_t slot = raster.slots[i]; slot < raster.slots[i + 1]; ++slot)
            for (int j = 0; j < kMomentCount; ++j) m[j] += moments[slot * kMomentCount + j];
        out.opacities[i] = m[0] / in.opacities[i];
        for (int j = 0; j < 3; ++j) out.colors[3 * i + j] = m[6 + j];
        // power = -(A dx^2 + 2 B dx dy + C dy^2) / 2 with dx = pixel - mean.
        const float A = 2.0f * s.xx / kLog2E, B = s.xy / kLog2E, C = 2.0f * s.yy / kLog2E;
        const float gx = A * m[1] + B * m[2], gy = B * m[1] + C * m[2];
        if (out.screen_offsets) out.screen_offsets[2 * i] = gx, out.screen_offsets[2 * i + 1] = gy;
        // dL/dcovariance = -Q G Q with Q the conic and G = dL/dQ.
        const float g00 = -0.5f * m[3], g01 = -0.5f * m[4], g11 = -0.5f * m[5];
        const float p00 = A * g00 + B * g01, p01 = A * g01 + B * g11, p10 = B * g00 + C * g01, p11 = B * g01 + C * g11;
        const float d00 = -(p00 * A + p01 * B), d01 = -(p00 * B + p01 * C), d11 = -(p10 * B + p11 * C);

        const float* quat = in.quats + 4 * i;
        const float* scale = in.scales + 3 * i;
        const Footprint f = footprint(c, in.means + 3 * i, quat, scale);
        const float inverse = 1.0f / f.point[2];
        float da[3], db[3], axes[9];
        float dux = 0.0f, duy = 0.0f, dz = 0.0f;
        for (int j = 0; j < 3; ++j) {
            da[j] = 2.0f * (d00 * f.a[j] + d01 * f.b[j]), db[j] = 2.0f * (d11 * f.b[j] + d01 * f.a[j]);
            const float ka = c.fx * inverse * da[j], kb = c.fy * inverse * db[j];
            axes[j] = ka, axes[3 + j] = kb, axes[6 + j] = -f.ux * ka - f.uy * kb;
            dux -= ka * f.axes[6 + j], duy -= kb * f.axes[6 + j];
            dz -= (da[j] * f.a[j] + db[j] * f.b[j]) * inverse;
        }
        // The projected mean always follows the point; the linearisation only where it is not clamped.
        float point[3] = {gx * c.fx * inverse, gy * c.fy * inverse, dz};
        point[2] -= (gx * c.fx * f.point[0] + gy * c.fy * f.point[1]) * inverse * inverse;
        if (f.free_x) point[0] += dux * inverse, point[2] -= dux * f.ux * inverse;
        if (f.free_y) point[1] += duy * inverse, point[2] -= duy * f.uy * inverse;
        for (int j = 0; j < 3; ++j)
            out.means[3 * i + j] = c.view[j] * point[0] + c.view[4 + j] * point[1] + c.view[8 + j] * point[2];

        float r[9], dr[9];
        rotation(quat, r);
        for (int j = 0; j < 3; ++j) {
            float ds = 0.0f;
            for (int k = 0; k < 3; ++k) {
                const float world = c.view[k] * axes[j] + c.view[4 + k] * axes[3 + j] + c.view[8 + k] * axes[6 + j];
                ds += world * r[3 * k + j];
                dr[3 * k + j] = world * scale[j];
            }
            out.scales[3 * i + j] = ds;
        }
        const float n = 1.0f / std::sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
        const float w = quat[0] * n, x = quat[1] * n, y = quat[2] * n, z = quat[3] * n;
        const float dq[4] = {
            2 * (z * (dr[3] - dr[1]) + y * (dr[2] - dr[6]) + x * (dr[7] - dr[5])),
            2 * (y * (dr[1] + dr[3]) + z * (dr[2] + dr[6]) + w * (dr[7] - dr[5]) - 2 * x * (dr[4] + dr[8])),
            2 * (x * (dr[1] + dr[3]) + z * (dr[5] + dr[7]) + w * (dr[2] - dr[6]) - 2 * y * (dr[0] + dr[8])),
            2 * (x * (dr[2] + dr[6]) + y * (dr[5] + dr[7]) + w * (dr[3] - dr[1]) - 2 * z * (dr[0] + dr[4]))};
        const float along = dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z;
        const float unit[4] = {w, x, y, z};
        for (int j = 0; j < 4; ++j) out.quats[4 * i + j] = n * (dq[j] - along * unit[j]);
    }
}

}  // namespace SGS_ISA
}  // namespace structgstream
