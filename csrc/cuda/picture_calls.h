// SPDX-License-Identifier: Apache-2.0
// The interface of picture.h: the lists and the drawing of the fit, for Gaussians that are given. picture.cu compiles it for
// a GPU, emulate_fit.cpp for a CPU.
#pragma once

#include "fit_memory.h"
#include "fit_raster.h"
#include "picture.h"

namespace structgstream {
namespace cuda {
namespace fit {

constexpr int kMapsAtOnce = 8;

struct Project {
    Camera camera;
    const float *means, *quats, *scales, *opacities, *colors, *intervals;
    Splat* splats;    // or null
    int32_t *counts, *slots;
    float* radii;     // or null

    SGS_LANES_FN void operator()(int64_t i) const {
        const float black[3] = {};
        const Splat s = projected(
            camera, means + 3 * i, quats + 4 * i, scales + 3 * i, opacities[i], colors == nullptr ? black : colors + 3 * i,
            intervals == nullptr ? nullptr : intervals + i, radii == nullptr ? nullptr : radii + i);
        if (splats == nullptr) return;
        splats[i] = s, slots[i] = slots_of(s);
        count_tiles(s, nullptr, camera.columns(), counts);
    }
};

// Sums over a pair's pixels of its blending weight times each of some maps, in the splat's slot of the tile.
struct Weigh {
    static constexpr int kThreads = kRasterThreads;
    using Shared = PairShared<kMapsAtOnce>;
    struct Warp {
        Front front;
        vf values[kMapsAtOnce];
    };
    Tiles tiles;
    const int32_t* slots;
    const float* maps;
    int channels, first, count;  // of the maps: all, and those that are summed here
    float* sums;                 // [slots, channels]

    SGS_LANES_FN void operator()(int tile, Shared& s, const Threads& threads) const {
        OfWarp<Warp, kWarps> warps;
        threads.warps([&](int w) {
            Warp& warp = warps[w];
            warp.front = {splat(0.0f), false};
            for (int k = 0; k < kMapsAtOnce; ++k) warp.values[k] = splat(0.0f);
            tiles.each_pixel(tile, w, [&](int l, int64_t pixel) {
                set(warp.front.T, l, 1.0f);
                for (int k = 0; k < kMapsAtOnce; ++k)
                    if (k < count) set(warp.values[k], l, maps[pixel * channels + first + k]);
            });
            warp.front.live = any(above(warp.front.T, splat(kMinGradientTransmittance)));
        });
        const auto values = [](Warp& warp, const Splat&, const Coverage& c, vf before, vf(&m)[kMapsAtOnce]) {
            for (int k = 0; k < kMapsAtOnce; ++k) m[k] = c.alpha * before * warp.values[k];
        };
        sum_pairs<kMapsAtOnce>(tiles, slots, tile, s, threads, warps, values, [&](int64_t slot, int k, float total) {
            if (k < count) sums[slot * channels + first + k] = total;
        });
    }
};

// A thread is a Gaussian.
struct SumWeights {
    const Splat* splats;
    const int32_t* slots;
    const float* sums;
    int channels;
    float* weights;

    SGS_ELEMENT void operator()(int64_t i) const {
        const int count = slots_of(splats[i]);
        for (int k = 0; k < channels; ++k) {
            float total = 0.0f;
            for (int64_t slot = slots[i]; slot < int64_t{slots[i]} + count; ++slot) total += sums[slot * channels + k];
            weights[i * channels + k] = total;
        }
    }
};

struct Complement {
    float* values;
    SGS_ELEMENT void operator()(int64_t i) const { values[i] = 1.0f - values[i]; }
};

// The memory of a picture, which is released in the end.
class Picture {
  public:
    explicit Picture(void* stream) : stream_(stream) {}
    ~Picture() {
        for (void* memory : {memory_, pair_memory_}) release(memory, stream_);
    }
    Picture(const Picture&) = delete;
    Picture& operator=(const Picture&) = delete;

    int draw(Project project, int64_t count, const float* background, const float* maps, int channels, float* weights,
             float* image, float* alpha) {
        camera_ = project.camera, count_ = count;
        Arena sizes(nullptr);
        lay_out(sizes, alpha == nullptr);
        if (const int error = allocate(&memory_, sizes.size(), stream_)) return error;
        Arena arena(memory_);
        lay_out(arena, alpha == nullptr);
        if (const int error = fill(counts_, 0, sizeof(int32_t) * camera_.tiles(), stream_)) return error;
        project.splats = splats_, project.counts = counts_, project.slots = slots_;
        if (const int error = for_each(project, count, stream_)) return error;
        const Starts starts = {counts_, camera_.tiles(), starts_, cursors_, count, slots_, nullptr, nullptr, 0,
                               kMostPairs, nullptr, totals_, totals_ + 1};
        if (const int error = for_blocks(starts, 1, stream_)) return error;
        int64_t totals[2];
        if (const int error = to_host(totals, totals_, sizeof totals, stream_)) return error;
        if (const int error = wait(stream_)) return error;
        if (totals[0] > kMostPairs || totals[1] > kMostPairs) return kNoMemory;
        Arena pair_sizes(nullptr);
        lay_out_pairs(pair_sizes, totals, channels);
        if (const int error = allocate(&pair_memory_, pair_sizes.size(), stream_)) return error;
        Arena pairs(pair_memory_);
        lay_out_pairs(pairs, totals, channels);
        const Scatter scatter = {nullptr, splats_, nullptr, camera_.columns(), cursors_, keys_};
        if (const int error = for_each(scatter, count, stream_)) return error;
        const Sort sort = {nullptr, nullptr, starts_, keys_, nullptr, nullptr, 0, rows_};
        if (const int error = for_blocks(sort, camera_.tiles(), stream_)) return error;
        const Tiles tiles = {nullptr, nullptr, camera_.columns(), camera_.width, camera_.height, count, splats_, nullptr,
                             starts_, nullptr, rows_, background};
        if (image != nullptr) {
            float* rest = alpha == nullptr ? transmittance_ : alpha;
            if (const int error = for_blocks(Draw{tiles, image, rest}, camera_.tiles(), stream_)) return error;
        }
        if (alpha != nullptr)
            if (const int error = for_each(Complement{alpha}, int64_t{camera_.width} * camera_.height, stream_)) return error;
        for (int first = 0; first < channels; first += kMapsAtOnce) {
            const int some = channels - first < kMapsAtOnce ? channels - first : kMapsAtOnce;
            const Weigh weigh = {tiles, slots_, maps, channels, first, some, sums_};
            if (const int error = for_blocks(weigh, camera_.tiles(), stream_)) return error;
        }
        return channels == 0 ? 0 : for_each(SumWeights{splats_, slots_, sums_, channels, weights}, count, stream_);
    }

  private:
    void lay_out(Arena& a, bool transmittance) {
        const int64_t tiles = camera_.tiles();
        splats_ = a.take<Splat>(count_), slots_ = a.take<int32_t>(count_);
        counts_ = a.take<int32_t>(tiles), starts_ = a.take<int32_t>(tiles + 1), cursors_ = a.take<int32_t>(tiles);
        totals_ = a.take<int64_t>(2);
        if (transmittance) transmittance_ = a.take<float>(int64_t{camera_.width} * camera_.height);
    }
    void lay_out_pairs(Arena& a, const int64_t (&totals)[2], int channels) {
        keys_ = a.take<uint64_t>(totals[0]), rows_ = a.take<int32_t>(totals[0]);
        sums_ = a.take<float>(totals[1] * channels);
    }

    void* stream_;
    Camera camera_ = {};
    int64_t count_ = 0;
    void *memory_ = nullptr, *pair_memory_ = nullptr;
    Splat* splats_ = nullptr;
    int32_t *slots_ = nullptr, *counts_ = nullptr, *starts_ = nullptr, *cursors_ = nullptr, *rows_ = nullptr;
    int64_t* totals_ = nullptr;
    uint64_t* keys_ = nullptr;
    float *transmittance_ = nullptr, *sums_ = nullptr;
};

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream

extern "C" {

int sgs_cuda_radii(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* viewmat, const float* K, int width, int height, float near_plane, const float* intervals, float* radii,
    void* stream) {
    using namespace structgstream::cuda;
    const fit::Camera camera = {viewmat, K, nullptr, near_plane, width, height};
    const fit::Project project = {camera, means, quats, scales, opacities, nullptr, intervals, nullptr, nullptr, nullptr, radii};
    return for_each(project, count, stream);
}

int sgs_cuda_picture(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* colors, const float* viewmat, const float* K, int width, int height, float near_plane,
    const float* background, const float* intervals, const float* maps, int channels, float* weights, float* image,
    float* alpha, float* radii, void* stream) {
    using namespace structgstream::cuda;
    const fit::Camera camera = {viewmat, K, nullptr, near_plane, width, height};
    const fit::Project project = {camera, means, quats, scales, opacities, colors, intervals, nullptr, nullptr, nullptr, radii};
    return fit::Picture(stream).draw(project, count, background, maps, channels, weights, image, alpha);
}

}  // extern "C"
