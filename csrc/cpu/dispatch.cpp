// SPDX-License-Identifier: Apache-2.0
// The C interface: each entry point calls the build of its kernel for the instruction set in use.

#include <algorithm>
#include <atomic>
#include <memory>
#include <new>

#include "bin.h"
#include "draw.h"
#include "lift.h"
#include "planes.h"
#include "splat.h"
#include "ssim.h"
#include "structgstream.h"
#include "visible.h"

// Every kernel source is compiled once for each instruction set into a namespace of this name (CMakeLists.txt).
#define SGS_DECLARE(ISA)                                                                                              \
    namespace structgstream::ISA {                                                                                    \
    void project(const GaussianInputs&, Raster&, float*, int);                                                        \
    void project_backward(const GaussianInputs&, const Raster&, const float*, const GaussianGradients&, int);         \
    void rasterize(const Raster&, const float*, float*, float*, int);                                                 \
    void weigh(const Raster&, const float*, int, float*, const float*, float*, int);                                  \
    void rasterize_backward(                                                                                          \
        const Raster&, const float*, const float*, const float*, const float*, const float*, float*, int);            \
    void l1_ssim(const Pictures&, const Part*, int, float*, int);                                                     \
    void l1_ssim_backward(const Pictures&, const Part*, int, const float*, float, float, float*, int);                \
    void anchors_visible(const sgs_anchors&, int64_t, const View&, const int32_t*, uint8_t*, int);                    \
    void anchors_select(const sgs_anchors&, sgs_selection&, int);                                                     \
    void anchors_dress(const sgs_anchors&, const sgs_selection&, const sgs_gaussians&, int);                          \
    void anchors_backward(                                                                                            \
        const sgs_anchors&, const sgs_selection&, const sgs_gaussians&, const sgs_gaussian_gradients&,                \
        const sgs_anchor_gradients&, int);                                                                            \
    void adam_step(                                                                                                   \
        float*, const float*, float*, float*, int64_t, double, int64_t, double, double, double, int);                 \
    void lift_flow(const FlowLift&, int);                                                                             \
    void plane_scores(const PlaneSweep&);                                                                             \
    double change_bits(const float*, const float*, int64_t, float, float*);                                           \
    void fold_appearance(const float*, const float*, const float*, int64_t, int, int, float*);                        \
    void fold_appearance_backward(const float*, const float*, int64_t, int, int, float*);                             \
    }

SGS_DECLARE(baseline)
#ifdef SGS_HAVE_AVX2
SGS_DECLARE(avx2)
#define SGS_AVX2(call) \
    case 1:            \
        return structgstream::avx2::call;
#else
#define SGS_AVX2(call)
#endif
#ifdef SGS_HAVE_AVX512
SGS_DECLARE(avx512)
#define SGS_AVX512(call) \
    case 2:              \
        return structgstream::avx512::call;
#else
#define SGS_AVX512(call)
#endif

#define SGS_DISPATCH(call)                      \
    switch (sgs_isa()) {                        \
        SGS_AVX512(call)                        \
        SGS_AVX2(call)                          \
        default:                                \
            return structgstream::baseline::call; \
    }

namespace {

using namespace structgstream;

int best_isa() {
#if defined(SGS_HAVE_AVX512)
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl"))
        return 2;
#endif
#if defined(SGS_HAVE_AVX2)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return 1;
#endif
    return 0;
}

std::atomic<int> isa{-1};

void weigh_dispatched(
    const Raster& raster, const float* maps, int channels, float* sums, const float* background, float* image,
    int threads) {
    SGS_DISPATCH(weigh(raster, maps, channels, sums, background, image, threads))
}

void l1_ssim_dispatched(const Pictures& pictures, const Part* parts, int count, float* gradient, int threads) {
    SGS_DISPATCH(l1_ssim(pictures, parts, count, gradient, threads))
}

void anchors_visible_dispatched(
    const sgs_anchors& anchors, int64_t count, const View& view, const int32_t* covered, uint8_t* visible, int threads) {
    SGS_DISPATCH(anchors_visible(anchors, count, view, covered, visible, threads))
}

void lift_flow_dispatched(const FlowLift& lift, int threads) { SGS_DISPATCH(lift_flow(lift, threads)) }

void plane_scores_dispatched(const PlaneSweep& sweep) { SGS_DISPATCH(plane_scores(sweep)) }

// A byte for each tile: whether any of its `channels` maps is not zero.
std::vector<uint8_t> tiles_with_values(const Raster& raster, const float* maps, int channels) {
    std::vector<uint8_t> found(static_cast<size_t>(raster.tiles_x) * raster.tiles_y, 0);
    const int width = raster.camera.width;
    for (int y = 0; y < raster.camera.height; ++y)
        for (int x = 0; x < width; ++x) {
            const float* pixel = maps + (static_cast<size_t>(y) * width + x) * channels;
            found[y / kTile * raster.tiles_x + x / kTile] |=
                std::any_of(pixel, pixel + channels, [](float value) { return value != 0.0f; });
        }
    return found;
}

}  // namespace

namespace structgstream {

void look(
    Raster& raster, const float* viewmat, const float* K, int width, int height, float near_plane,
    const uint8_t* drawn_tiles) {
    Pinhole& c = raster.camera;
    std::copy_n(viewmat, 12, c.view);
    c.fx = K[0], c.fy = K[4], c.cx = K[2], c.cy = K[5];
    const float margin_x = 0.3f * 0.5f * width / c.fx, margin_y = 0.3f * 0.5f * height / c.fy;
    c.left = c.cx / c.fx + margin_x, c.right = (width - c.cx) / c.fx + margin_x;
    c.up = c.cy / c.fy + margin_y, c.down = (height - c.cy) / c.fy + margin_y;
    c.near = near_plane, c.width = width, c.height = height;
    raster.tiles_x = (width + kTile - 1) / kTile;
    raster.tiles_y = (height + kTile - 1) / kTile;
    raster.drawn_tiles.clear();
    if (drawn_tiles) raster.drawn_tiles.assign(drawn_tiles, drawn_tiles + raster.tiles_x * raster.tiles_y);
}

void project(const GaussianInputs& in, Raster& raster, float* radii, int threads) {
    SGS_DISPATCH(project(in, raster, radii, threads))
}

void rasterize(const Raster& raster, const float* background, float* image, float* alpha, int threads) {
    SGS_DISPATCH(rasterize(raster, background, image, alpha, threads))
}

void rasterize_backward(
    const Raster& raster, const float* background, const float* image, const float* alpha, const float* grad_image,
    const float* grad_alpha, float* moments, int threads) {
    SGS_DISPATCH(rasterize_backward(raster, background, image, alpha, grad_image, grad_alpha, moments, threads))
}

void project_backward(
    const GaussianInputs& in, const Raster& raster, const float* moments, const GaussianGradients& out, int threads) {
    SGS_DISPATCH(project_backward(in, raster, moments, out, threads))
}

void fold_appearance(
    const float* features, const float* appearance, const float* basis, int64_t count, int size, int rank,
    float* folded) {
    SGS_DISPATCH(fold_appearance(features, appearance, basis, count, size, rank, folded))
}

void fold_appearance_backward(
    const float* to_folded, const float* basis, int64_t count, int size, int rank, float* gradient) {
    SGS_DISPATCH(fold_appearance_backward(to_folded, basis, count, size, rank, gradient))
}

}  // namespace structgstream

extern "C" {

int sgs_abi_version(void) { return SGS_ABI_VERSION; }

int sgs_best_isa(void) { return best_isa(); }

int sgs_isa(void) {
    int current = isa.load(std::memory_order_relaxed);
    if (current < 0) isa.store(current = best_isa(), std::memory_order_relaxed);
    return current;
}

int sgs_use_isa(int wanted) {
    isa.store(std::max(0, std::min(wanted, best_isa())), std::memory_order_relaxed);
    return sgs_isa();
}

void* sgs_raster_forward(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* colors, const float* viewmat, const float* K, int width, int height, float near_plane,
    const float* background, const float* screen_offsets, const float* intervals, const uint8_t* drawn_tiles,
    int64_t trained, float* image, float* alpha, float* radii, int threads) {
    try {
        auto raster = std::make_unique<Raster>();
        look(*raster, viewmat, K, width, height, near_plane, drawn_tiles);
        raster->trained = trained;
        raster->splats.resize(count);
        project({means, quats, scales, opacities, colors, screen_offsets, intervals, count}, *raster, radii, threads);
        bin(*raster);
        rasterize(*raster, background, image, alpha, threads);
        return raster.release();
    } catch (const std::bad_alloc&) {
        return nullptr;
    }
}

int sgs_raster_radii(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* viewmat, const float* K, int width, int height, float near_plane, const float* intervals, float* radii,
    int threads) {
    try {
        Raster raster;
        look(raster, viewmat, K, width, height, near_plane, nullptr);
        raster.splats.resize(count);
        // Colours are not used; any memory of the right size is sufficient.
        project({means, quats, scales, opacities, means, nullptr, intervals, count}, raster, radii, threads);
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

int sgs_raster_weights(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* colors, const float* viewmat, const float* K, int width, int height, float near_plane,
    const float* background, const float* intervals, const float* maps, int channels, float* weights, float* image,
    int threads) {
    try {
        Raster raster;
        look(raster, viewmat, K, width, height, near_plane, nullptr);
        if (!image) raster.drawn_tiles = tiles_with_values(raster, maps, channels);
        raster.trained = 0;
        raster.splats.resize(count);
        std::vector<float> radii(count);
        // Without a picture colours are not used; any memory of the right size is sufficient.
        project(
            {means, quats, scales, opacities, image ? colors : means, nullptr, intervals, count}, raster, radii.data(),
            threads);
        bin(raster);
        const std::unique_ptr<float[]> sums(new float[raster.pairs.size() * channels]);
        weigh_dispatched(raster, maps, channels, sums.get(), background, image, threads);
        std::fill_n(weights, count * channels, 0.0f);
        for (int64_t i = 0; i < count; ++i)
            for (int64_t slot = raster.slots[i]; slot < raster.slots[i + 1]; ++slot)
                for (int c = 0; c < channels; ++c) weights[i * channels + c] += sums[slot * channels + c];
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

int sgs_lift_flow(
    const float* centers, const float* weights, const float* flows, const float* viewmats, const float* Ks,
    const float* near_planes, const int64_t* neighbours, const float* affinities, const float* priors, int64_t movers,
    int64_t targets, int views, int neighbour_count, float share, float* displacements, float* inlier_share,
    int64_t* agreeing_views, int threads) {
    try {
        lift_flow_dispatched(
            {centers, weights, flows, viewmats, Ks, near_planes, neighbours, affinities, priors, movers, targets, views,
             neighbour_count, share, displacements, inlier_share, agreeing_views},
            threads);
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

int sgs_plane_scores(
    const float* picture, int height, int width, const sgs_neighbour* neighbours, int neighbour_count,
    const double* homographies, int64_t planes, int window, float noise, float* scores) {
    try {
        plane_scores_dispatched(
            {picture, height, width, neighbours, neighbour_count, homographies, planes, window, noise, scores});
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

int sgs_raster_backward(
    const void* state, int64_t count, const float* means, const float* quats, const float* scales,
    const float* opacities, const float* colors, const float* background, const float* image, const float* alpha,
    const float* grad_image, const float* grad_alpha, float* grad_means, float* grad_quats, float* grad_scales,
    float* grad_opacities, float* grad_colors, float* grad_screen_offsets, int threads) {
    const Raster& raster = *static_cast<const Raster*>(state);
    const size_t numbers = static_cast<size_t>(raster.slots[raster.trained]) * kMomentCount;
    const std::unique_ptr<float[]> moments(new (std::nothrow) float[numbers]);
    if (!moments) return 1;
    rasterize_backward(raster, background, image, alpha, grad_image, grad_alpha, moments.get(), threads);
    project_backward(
        {means, quats, scales, opacities, colors, nullptr, nullptr, count}, raster, moments.get(),
        {grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_screen_offsets}, threads);
    return 0;
}

void sgs_raster_free(void* state) { delete static_cast<Raster*>(state); }

void sgs_l1_ssim(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, float* gradient, double* row_l1, double* row_ssim, int threads) {
    const Parts parts(height, width, tiles, threads);
    std::fill_n(row_l1, height, 0.0);
    std::fill_n(row_ssim, height, 0.0);
    l1_ssim_dispatched(
        {image, target, target_u8, gains, biases, height, width}, parts.data(), parts.count(), gradient, threads);
    parts.add_to(row_l1, row_ssim);
}

void sgs_l1_ssim_backward(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, const float* ssim_gradient, float l1_scale, float ssim_scale,
    float* gradient, int threads) {
    const Parts parts(height, width, tiles, threads);
    const Pictures pictures{image, target, target_u8, gains, biases, height, width};
    SGS_DISPATCH(l1_ssim_backward(
        pictures, parts.data(), parts.count(), ssim_gradient, l1_scale, ssim_scale, gradient, threads))
}

int64_t sgs_anchors_visible(
    const sgs_anchors* anchors, int64_t count, const float* intervals, const float* viewmat, const float* K, int width,
    int height, float near_plane, const uint8_t* tiles, int64_t* visible, int threads) {
    View view;
    view.intervals = intervals;
    std::copy_n(viewmat, 12, view.viewmat);
    view.fx = K[0], view.fy = K[4], view.cx = K[2], view.cy = K[5], view.near = near_plane;
    view.width = width, view.height = height;
    view.tiles_x = (width + kTile - 1) / kTile, view.tiles_y = (height + kTile - 1) / kTile;
    try {
        std::vector<int32_t> covered;
        if (tiles) {
            const int row = view.tiles_x + 1;
            covered.assign(static_cast<size_t>(row) * (view.tiles_y + 1), 0);
            for (int y = 0; y < view.tiles_y; ++y)
                for (int x = 0; x < view.tiles_x; ++x)
                    covered[(y + 1) * row + x + 1] = covered[y * row + x + 1] + covered[(y + 1) * row + x] -
                                                     covered[y * row + x] + (tiles[y * view.tiles_x + x] != 0);
        }
        std::vector<uint8_t> seen(count);
        anchors_visible_dispatched(*anchors, count, view, tiles ? covered.data() : nullptr, seen.data(), threads);
        int64_t found = 0;
        for (int64_t i = 0; i < count; ++i)
            if (seen[i]) visible[found++] = i;
        return found;
    } catch (const std::bad_alloc&) {
        return -1;
    }
}

void sgs_anchors_select(const sgs_anchors* anchors, sgs_selection* selection, int threads) {
    SGS_DISPATCH(anchors_select(*anchors, *selection, threads))
}

void sgs_anchors_dress(
    const sgs_anchors* anchors, const sgs_selection* selection, const sgs_gaussians* out, int threads) {
    SGS_DISPATCH(anchors_dress(*anchors, *selection, *out, threads))
}

void sgs_anchors_backward(
    const sgs_anchors* anchors, const sgs_selection* selection, const sgs_gaussians* drawn,
    const sgs_gaussian_gradients* from, const sgs_anchor_gradients* to, int threads) {
    SGS_DISPATCH(anchors_backward(*anchors, *selection, *drawn, *from, *to, threads))
}

double sgs_change_bits(const float* values, const float* before, int64_t count, float step, float* gradient) {
    SGS_DISPATCH(change_bits(values, before, count, step, gradient))
}

void sgs_adam_step(
    float* param, const float* grad, float* first, float* second, int64_t count, double lr, int64_t step, double beta1,
    double beta2, double eps, int threads) {
    SGS_DISPATCH(adam_step(param, grad, first, second, count, lr, step, beta1, beta2, eps, threads))
}

}  // extern "C"
