// SPDX-License-Identifier: Apache-2.0
// A Gaussian as a splat of a picture (EWA: Zwicker et al., 2001), and the gradient back; the formulas are those of
// csrc/cpu/project.cpp.
#pragma once

#include <cmath>
#include <cstdint>

#include "lanes.h"

namespace structgstream {
namespace cuda {
namespace fit {

constexpr float kLog2E = 1.44269504f;
constexpr float kLowPass = 0.3f;         // square pixels: reference_raster.LOW_PASS_PIXELS
constexpr float kScreenLowPass = 0.15f;  // reference_raster.SCREEN_LOW_PASS_PIXELS
constexpr float kMinAlpha = 1.0f / 255.0f, kLog2MinAlpha = -7.99435344f, kMaxAlpha = 0.999f;
constexpr float kBoxSlack = 0.01f;       // pixels
constexpr float kFar = 1e7f;             // pixels: integers would overflow beyond it
constexpr int kMoments = 9;  // of dL/dpower over a pair's pixels (1, dx, dy, dx^2, dx dy, dy^2), and dL/dcolor

// alpha = 2^(log2_opacity - (xx dx^2 + xy dx dy + yy dy^2)).
struct alignas(16) Splat {
    float x, y, xx, xy, yy, log2_opacity, color[3], depth;
    float reach;       // the quadratic form at the centre of a warp's block of pixels that may be covered is at most this
    int16_t tiles[4];  // x0, y0, x1, y1 (half open); x0 = x1 if it is not drawn
    float unused[3];
};
static_assert(sizeof(Splat) == 64, "four loads of sixteen bytes");

struct Camera {
    const float *viewmat, *K, *center;
    float near;
    int width, height;

    SGS_ELEMENT int columns() const { return (width + kTilePixels - 1) / kTilePixels; }
    SGS_ELEMENT int rows() const { return (height + kTilePixels - 1) / kTilePixels; }
    SGS_ELEMENT int tiles() const { return columns() * rows(); }
};

struct Footprint {
    float fx, fy, cx, cy;
    float point[3], inverse, ux, uy;
    bool free_x, free_y;  // not clamped
    float unit[4], inverse_norm, r[9];
    float axes[9], a[3], b[3];

    SGS_ELEMENT Footprint(const Camera& c, const float* mean, const float* quat, const float* scale)
        : fx(c.K[0]), fy(c.K[4]), cx(c.K[2]), cy(c.K[5]) {
        const float* v = c.viewmat;
        for (int i = 0; i < 3; ++i)
            point[i] = v[4 * i] * mean[0] + v[4 * i + 1] * mean[1] + v[4 * i + 2] * mean[2] + v[4 * i + 3];
        inverse = 1.0f / point[2];
        const float x = point[0] * inverse, y = point[1] * inverse;
        const float margin_x = 0.3f * 0.5f * static_cast<float>(c.width) / fx;
        const float margin_y = 0.3f * 0.5f * static_cast<float>(c.height) / fy;
        const float left = cx / fx + margin_x, right = (static_cast<float>(c.width) - cx) / fx + margin_x;
        const float up = cy / fy + margin_y, down = (static_cast<float>(c.height) - cy) / fy + margin_y;
        ux = fminf(right, fmaxf(-left, x)), uy = fminf(down, fmaxf(-up, y));
        free_x = x >= -left && right >= x, free_y = y >= -up && down >= y;
        inverse_norm = 1.0f / sqrtf(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
        for (int i = 0; i < 4; ++i) unit[i] = quat[i] * inverse_norm;
        const float w = unit[0], i = unit[1], j = unit[2], k = unit[3];
        r[0] = 1.0f - 2.0f * (j * j + k * k), r[1] = 2.0f * (i * j - w * k), r[2] = 2.0f * (i * k + w * j);
        r[3] = 2.0f * (i * j + w * k), r[4] = 1.0f - 2.0f * (i * i + k * k), r[5] = 2.0f * (j * k - w * i);
        r[6] = 2.0f * (i * k - w * j), r[7] = 2.0f * (j * k + w * i), r[8] = 1.0f - 2.0f * (i * i + j * j);
        for (int row = 0; row < 3; ++row)
            for (int axis = 0; axis < 3; ++axis)
                axes[3 * row + axis] = (v[4 * row] * r[axis] + v[4 * row + 1] * r[3 + axis] +
                                        v[4 * row + 2] * r[6 + axis]) * scale[axis];
        for (int axis = 0; axis < 3; ++axis) {
            a[axis] = fx * inverse * (axes[axis] - ux * axes[6 + axis]);
            b[axis] = fy * inverse * (axes[3 + axis] - uy * axes[6 + axis]);
        }
    }
};

// interval: the size of a training pixel at the Gaussian, or null: the low-pass is that of the picture. radius, if it is not
// null: pixels, 0 out of the picture. offset: pixels that are added to the projected mean, or null.
SGS_ELEMENT Splat projected(
    const Camera& c, const float* mean, const float* quat, const float* scale, float opacity, const float* color,
    const float* interval, float* radius = nullptr, const float* offset = nullptr) {
    Splat s = {};
    if (radius != nullptr) *radius = 0.0f;
    float finite = opacity * 0.0f;
    for (int i = 0; i < 3; ++i) finite += mean[i] * 0.0f + scale[i] * 0.0f + color[i] * 0.0f;
    for (int i = 0; i < 4; ++i) finite += quat[i] * 0.0f;
    const Footprint f(c, mean, quat, scale);
    float low_pass = kLowPass;
    if (interval != nullptr) {  // reference_raster.screen_low_pass
        finite += *interval * 0.0f;
        const float side = *interval * f.inverse;
        low_pass *= f.fx * f.fy * side * side;
        // The determinant without low-pass is the square of a cross product, which does not cancel for needles.
        float square = 0.0f, size = 0.0f;
        for (int j = 0; j < 3; ++j) {
            const int k = (j + 1) % 3, l = (j + 2) % 3;
            const float normal = f.a[k] * f.b[l] - f.a[l] * f.b[k];
            square += normal * normal, size += f.a[j] * f.a[j] + f.b[j] * f.b[j];
        }
        const float total = fmaxf(low_pass, kScreenLowPass);
        opacity *= sqrtf((square + low_pass * (size + low_pass)) / (square + total * (size + total)));
        low_pass = total;
    }
    float xx = low_pass, xy = 0.0f, yy = low_pass;
    for (int j = 0; j < 3; ++j) xx += f.a[j] * f.a[j], xy += f.a[j] * f.b[j], yy += f.b[j] * f.b[j];
    const float determinant = xx * yy - xy * xy;
    float x = f.fx * f.point[0] * f.inverse + f.cx, y = f.fy * f.point[1] * f.inverse + f.cy;
    if (offset != nullptr) x += offset[0], y += offset[1];
    // The exact box of alpha = 1/255, which shrinks with the opacity.
    const float log2_opacity = log2f(fmaxf(opacity, kMinAlpha)), rise = fmaxf(0.0f, log2_opacity - kLog2MinAlpha);
    const float half_x = sqrtf(rise * (2.0f / kLog2E) * xx), half_y = sqrtf(rise * (2.0f / kLog2E) * yy);
    const float width = static_cast<float>(c.width), height = static_cast<float>(c.height);
    const bool seen = opacity >= kMinAlpha && f.point[2] >= c.near && finite <= 0.0f && determinant > 0.0f &&
                      half_x < kFar && half_y < kFar && fabsf(x) < kFar && fabsf(y) < kFar && x + half_x > 0.0f &&
                      y + half_y > 0.0f && x - half_x < width && y - half_y < height;
    if (!seen) return s;
    if (radius != nullptr) *radius = fmaxf(half_x, half_y);
    // Pixels whose centre is in the box, with slack for rounding.
    const float low_x = fmaxf(0.0f, ceilf(x - half_x - (0.5f + kBoxSlack)));
    const float low_y = fmaxf(0.0f, ceilf(y - half_y - (0.5f + kBoxSlack)));
    const float high_x = fminf(width, floorf(x + half_x + (0.5f + kBoxSlack)));
    const float high_y = fminf(height, floorf(y + half_y + (0.5f + kBoxSlack)));
    if (!(low_x < high_x && low_y < high_y)) return s;
    const auto tile = [](float pixel) { return static_cast<int16_t>(static_cast<int>(pixel) / kTilePixels); };
    s.tiles[0] = tile(low_x), s.tiles[1] = tile(low_y);
    s.tiles[2] = static_cast<int16_t>(tile(high_x - 1.0f) + 1), s.tiles[3] = static_cast<int16_t>(tile(high_y - 1.0f) + 1);
    const float normal = (0.5f * kLog2E) / determinant;
    s.x = x, s.y = y, s.xx = yy * normal, s.xy = -2.0f * xy * normal, s.yy = xx * normal;
    s.log2_opacity = log2_opacity, s.depth = f.point[2];
    for (int i = 0; i < 3; ++i) s.color[i] = color[i];
    // Distance of a pixel's centre from its block's centre, for the triangle inequality.
    constexpr float kAside = 0.5f * (kBlockX - 1), kBelow = 0.5f * (kBlockY - 1);
    const float within =
        sqrtf(rise) + sqrtf(kAside * kAside * s.xx + kBelow * kBelow * s.yy + kAside * kBelow * fabsf(s.xy));
    s.reach = within * within * 1.0001f + 1e-4f;
    return s;
}

struct AttributeGradients {
    float mean[3], quat[4], scale[3], opacity, color[3], offset[2];
};

// From the sums of a splat's moments.
SGS_ELEMENT AttributeGradients projected_backward(
    const Camera& c, const Splat& s, const float* m, const float* mean, const float* quat, const float* scale,
    float opacity) {
    // power = -(A dx^2 + 2 B dx dy + C dy^2) / 2 with dx = pixel - mean.
    const float A = s.xx * (2.0f / kLog2E), B = s.xy * (1.0f / kLog2E), C = s.yy * (2.0f / kLog2E);
    const float gx = A * m[1] + B * m[2], gy = B * m[1] + C * m[2];
    // dL/dcovariance = -Q G Q with Q the conic and G = dL/dQ.
    const float g00 = -0.5f * m[3], g01 = -0.5f * m[4], g11 = -0.5f * m[5];
    const float p00 = A * g00 + B * g01, p01 = A * g01 + B * g11, p10 = B * g00 + C * g01, p11 = B * g01 + C * g11;
    const float d00 = -(p00 * A + p01 * B), d01 = -(p00 * B + p01 * C), d11 = -(p10 * B + p11 * C);
    const Footprint f(c, mean, quat, scale);
    float axes[9], dux = 0.0f, duy = 0.0f, dz = 0.0f;
    for (int j = 0; j < 3; ++j) {
        const float da = 2.0f * (d00 * f.a[j] + d01 * f.b[j]), db = 2.0f * (d11 * f.b[j] + d01 * f.a[j]);
        const float ka = f.fx * f.inverse * da, kb = f.fy * f.inverse * db;
        axes[j] = ka, axes[3 + j] = kb, axes[6 + j] = -f.ux * ka - f.uy * kb;
        dux -= ka * f.axes[6 + j], duy -= kb * f.axes[6 + j];
        dz -= (da * f.a[j] + db * f.b[j]) * f.inverse;
    }
    // The projected mean always follows the point; the linearisation only where it is not clamped.
    float point[3] = {gx * f.fx * f.inverse, gy * f.fy * f.inverse, dz};
    point[2] -= (gx * f.fx * f.point[0] + gy * f.fy * f.point[1]) * f.inverse * f.inverse;
    const float along_x = f.free_x ? dux * f.inverse : 0.0f, along_y = f.free_y ? duy * f.inverse : 0.0f;
    point[0] += along_x, point[1] += along_y;
    point[2] -= along_x * f.ux + along_y * f.uy;
    AttributeGradients out;
    const float* v = c.viewmat;
    for (int j = 0; j < 3; ++j) out.mean[j] = v[j] * point[0] + v[4 + j] * point[1] + v[8 + j] * point[2];
    float dr[9];
    for (int j = 0; j < 3; ++j) {
        out.scale[j] = 0.0f;
        for (int k = 0; k < 3; ++k) {
            const float world = v[k] * axes[j] + v[4 + k] * axes[3 + j] + v[8 + k] * axes[6 + j];
            out.scale[j] += world * f.r[3 * k + j];
            dr[3 * k + j] = world * scale[j];
        }
    }
    const float w = f.unit[0], x = f.unit[1], y = f.unit[2], z = f.unit[3];
    const float dq[4] = {
        2.0f * (z * (dr[3] - dr[1]) + y * (dr[2] - dr[6]) + x * (dr[7] - dr[5])),
        2.0f * (y * (dr[1] + dr[3]) + z * (dr[2] + dr[6]) + w * (dr[7] - dr[5]) - 2.0f * x * (dr[4] + dr[8])),
        2.0f * (x * (dr[1] + dr[3]) + z * (dr[5] + dr[7]) + w * (dr[2] - dr[6]) - 2.0f * y * (dr[0] + dr[8])),
        2.0f * (x * (dr[2] + dr[6]) + y * (dr[5] + dr[7]) + w * (dr[3] - dr[1]) - 2.0f * z * (dr[0] + dr[4]))};
    const float along = dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z;
    for (int j = 0; j < 4; ++j) out.quat[j] = f.inverse_norm * (dq[j] - along * f.unit[j]);
    out.opacity = m[0] / opacity;
    out.offset[0] = gx, out.offset[1] = gy;
    for (int j = 0; j < 3; ++j) out.color[j] = m[6 + j];
    return out;
}

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream
