// SPDX-License-Identifier: Apache-2.0
// The interface of picture.h: the lists and the drawing of the fit, for Gaussians of several views that are given. picture.cu
// compiles it for a GPU, emulate_fit.cpp for a CPU.
#pragma once

#include <algorithm>
#include <new>
#include <vector>

#include "display.h"
#include "fit_memory.h"
#include "fit_raster.h"
#include "picture.h"

namespace structgstream {
namespace cuda {
namespace fit {

constexpr int kMapsAtOnce = 8;

struct Project {
    Camera camera;
    sgs_cuda_gaussians given;
    const uint8_t* drawn;  // or null: all tiles are
    Splat* splats;
    int32_t *counts, *slots;
    float* radii;          // or null

    SGS_LANES_FN void operator()(int64_t i) const {
        float radius = 0.0f;
        const Splat s = splat_of(given, camera, i, &radius);
        splats[i] = s, slots[i] = slots_of(s);
        count_tiles(s, drawn, camera.columns(), counts);
        if (radii != nullptr) radii[i] = reaches_drawn(s) ? radius : 0.0f;
    }

    static SGS_LANES_FN Splat splat_of(const sgs_cuda_gaussians& g, const Camera& camera, int64_t i, float* radius) {
        const float black[3] = {};
        return projected(
            camera, g.means + 3 * i, g.quats + 4 * i, g.scales + 3 * i, g.opacities[i],
            g.colors == nullptr ? black : g.colors + 3 * i, g.intervals == nullptr ? nullptr : g.intervals + i, radius,
            g.screen_offsets == nullptr ? nullptr : g.screen_offsets + 2 * i);
    }

    // A splat between pixel centres reaches none, and counts.
    SGS_LANES_FN bool reaches_drawn(const Splat& s) const {
        if (drawn == nullptr || s.tiles[0] >= s.tiles[2]) return true;
        for (int y = s.tiles[1]; y < s.tiles[3]; ++y)
            for (int x = s.tiles[0]; x < s.tiles[2]; ++x)
                if (drawn[y * camera.columns() + x]) return true;
        return false;
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
    const int64_t* ids;
    const float* sums;
    int channels;
    float* weights;  // by id

    SGS_ELEMENT void operator()(int64_t i) const {
        const int count = slots_of(splats[i]);
        for (int k = 0; k < channels; ++k) {
            float total = 0.0f;
            for (int64_t slot = slots[i]; slot < int64_t{slots[i]} + count; ++slot) total += sums[slot * channels + k];
            weights[ids[i] * channels + k] = total;
        }
    }
};

// From transmittance to coverage, which is zero where nothing is drawn.
struct Cover {
    const uint8_t* drawn;
    int width, columns;
    const float* transmittance;
    float* alpha;  // may be the same memory

    SGS_ELEMENT void operator()(int64_t i) const {
        const int64_t tile = i / width / kTilePixels * columns + i % width / kTilePixels;
        alpha[i] = drawn == nullptr || drawn[tile] ? 1.0f - transmittance[i] : 0.0f;
    }
};

// From the moments of a Gaussian's slots to its gradients; those of static ones, from `count` on, are zero.
struct ProjectBackward {
    Camera camera;
    sgs_cuda_gaussians given;
    const uint8_t* drawn;
    const Splat* splats;
    const int32_t* slots;
    const float* moments;
    sgs_cuda_gradients to;

    SGS_ELEMENT void operator()(int64_t i) const {
        AttributeGradients g = {};
        if (i < given.count && splats[i].tiles[0] < splats[i].tiles[2]) {
            float sums[kMoments];
            sum_moments(splats[i], drawn, camera.columns(), slots[i], moments, sums);
            g = projected_backward(
                camera, splats[i], sums, given.means + 3 * i, given.quats + 4 * i, given.scales + 3 * i, given.opacities[i]);
        }
        for (int j = 0; j < 3; ++j)
            to.means[3 * i + j] = g.mean[j], to.scales[3 * i + j] = g.scale[j], to.colors[3 * i + j] = g.color[j];
        for (int j = 0; j < 4; ++j) to.quats[4 * i + j] = g.quat[j];
        to.opacities[i] = g.opacity;
        for (int j = 0; j < 2 && to.screen_offsets != nullptr; ++j) to.screen_offsets[2 * i + j] = g.offset[j];
    }
};

// Marks the tiles within the margin of a Gaussian, which is truncated at two standard deviations (0.6 of its extent).
struct Reach {
    sgs_cuda_reach view;

    SGS_LANES_FN void operator()(int64_t i) const {
        if (view.visible[view.gaussians.ids[i]] == 0) return;
        const Camera reduced = {
            view.viewmat, view.reduced_K, nullptr, view.near_plane, view.reduced_width, view.reduced_height};
        float radius = 0.0f;
        Project::splat_of(view.gaussians, reduced, i, &radius);
        if (!(radius > 0.0f)) return;
        const float *m = view.gaussians.means + 3 * i, *v = view.viewmat;
        float p[3];
        for (int axis = 0; axis < 3; ++axis)
            p[axis] = v[4 * axis] * m[0] + v[4 * axis + 1] * m[1] + v[4 * axis + 2] * m[2] + v[4 * axis + 3];
        const float ratio = static_cast<float>(view.width) / static_cast<float>(view.reduced_width);
        const float reach = 0.6f * radius * ratio + view.margin;
        const int limits[2] = {(view.width + kTilePixels - 1) / kTilePixels, (view.height + kTilePixels - 1) / kTilePixels};
        int first[2], last[2];
        for (int axis = 0; axis < 2; ++axis) {
            const float center = view.K[4 * axis] * p[axis] / p[2] + view.K[3 * axis + 2];
            const float most = static_cast<float>(limits[axis] - 1);
            const float low = floorf((center - reach) / kTilePixels), high = floorf((center + reach) / kTilePixels);
            if (!(high >= 0.0f && low <= most)) return;
            first[axis] = static_cast<int>(fmaxf(low, 0.0f)), last[axis] = static_cast<int>(fminf(high, most));
        }
        for (int y = first[1]; y <= last[1]; ++y)
            for (int x = first[0]; x <= last[0]; ++x) view.tiles[y * limits[0] + x] = 1;
    }
};

// A kernel of each view, and its number of elements or blocks.
template <typename Kernel>
struct Counted {
    Kernel kernel;
    int64_t count;
};

template <typename Kernel>
struct EachElement {
    const Counted<Kernel>* kernels;
    int64_t most;

    SGS_LANES_FN void operator()(int64_t i) const {
        const Counted<Kernel>& of_view = kernels[i / most];
        if (i % most < of_view.count) of_view.kernel(i % most);
    }
};

template <typename Kernel>
struct EachBlock {
    static constexpr int kThreads = Kernel::kThreads;
    using Shared = typename Kernel::Shared;
    const Counted<Kernel>* kernels;
    int64_t most;

    SGS_LANES_FN void operator()(int block, Shared& s, const Threads& threads) const {
        const Counted<Kernel>& of_view = kernels[block / most];
        if (block % most < of_view.count) of_view.kernel(static_cast<int>(block % most), s, threads);
    }
};

// Runs the kernels of all views in one launch, whose arguments are copied to the device if there are several.
template <typename Kernel, typename Launch>
int launch(const std::vector<Counted<Kernel>>& kernels, void* stream, const Launch& run) {
    int64_t most = 0;
    for (const Counted<Kernel>& of_view : kernels) most = std::max(most, of_view.count);
    void* memory = nullptr;
    const size_t bytes = sizeof(Counted<Kernel>) * kernels.size();
    if (most == 0) return 0;
    if (const int error = allocate(&memory, bytes, stream)) return error;
    int error = to_device(memory, kernels.data(), bytes, stream);
    if (error == 0) error = run(static_cast<const Counted<Kernel>*>(memory), most, most * static_cast<int64_t>(kernels.size()));
    const int released = release(memory, stream);
    return error ? error : released;
}
template <typename Kernel>
int each_element(const std::vector<Counted<Kernel>>& kernels, void* stream) {
    if (kernels.size() == 1) return for_each(kernels[0].kernel, kernels[0].count, stream);
    return launch(kernels, stream, [&](const Counted<Kernel>* on_device, int64_t most, int64_t all) {
        return for_each(EachElement<Kernel>{on_device, most}, all, stream);
    });
}
template <typename Kernel>
int each_block(const std::vector<Counted<Kernel>>& kernels, void* stream) {
    if (kernels.size() == 1) return for_blocks(kernels[0].kernel, kernels[0].count, stream);
    return launch(kernels, stream, [&](const Counted<Kernel>* on_device, int64_t most, int64_t all) {
        return for_blocks(EachBlock<Kernel>{on_device, most}, all, stream);
    });
}

// The memory of several views, which is released in the end. differentiable: what the gradients need is kept.
class Views {
  public:
    Views(const sgs_cuda_view* views, int count, bool differentiable, void* stream)
        : stream_(stream), differentiable_(differentiable) {
        for (int v = 0; v < count; ++v) views_.push_back({views[v]});
    }
    ~Views() {
        for (void* memory : {memory_, pair_memory_}) release(memory, stream_);
    }
    Views(const Views&) = delete;
    Views& operator=(const Views&) = delete;

    int draw() {
        if (const int error = list()) return error;
        std::vector<Counted<Draw>> draws;
        std::vector<Counted<Cover>> covers;
        std::vector<Counted<SumWeights>> sums;
        int channels = 0;
        for (const Of& o : views_) {
            const sgs_cuda_view& v = o.view;
            if (v.image != nullptr)
                draws.push_back({{o.lists(), v.image, o.transmittance}, o.camera().tiles()});
            if (v.alpha != nullptr)
                covers.push_back(
                    {{v.tiles, v.width, o.camera().columns(), o.transmittance, v.alpha}, int64_t{v.width} * v.height});
            if (v.channels > 0)
                sums.push_back({{o.splats, o.slots, v.gaussians.ids, o.sums, v.channels, v.sums}, v.gaussians.count});
            channels = std::max(channels, v.channels);
        }
        if (const int error = each_block(draws, stream_)) return error;
        if (const int error = each_element(covers, stream_)) return error;
        for (int first = 0; first < channels; first += kMapsAtOnce) {
            std::vector<Counted<Weigh>> weighs;
            for (const Of& o : views_) {
                const int some = std::min(o.view.channels - first, kMapsAtOnce);
                if (some > 0)
                    weighs.push_back(
                        {{o.lists(), o.slots, o.view.maps, o.view.channels, first, some, o.sums}, o.camera().tiles()});
            }
            if (const int error = each_block(weighs, stream_)) return error;
        }
        return each_element(sums, stream_);
    }

    // Gradients of the Gaussians of the only view, after draw.
    int backward(const float* to_image, const float* to_alpha, const sgs_cuda_gradients& to, void* stream) {
        const Of& o = views_[0];
        const sgs_cuda_view& v = o.view;
        const Camera camera = o.camera();
        void* moments = nullptr;
        if (const int error = allocate(&moments, sizeof(float) * kMoments * o.slot_count, stream)) return error;
        float* sums = static_cast<float*>(moments);
        int error = for_blocks(
            DrawBackward{o.lists(), o.slots, v.image, o.transmittance, to_image, to_alpha, sums}, camera.tiles(), stream);
        if (error == 0)
            error = for_each(
                ProjectBackward{camera, v.gaussians, v.tiles, o.splats, o.slots, sums, to}, o.count(), stream);
        const int released = release(moments, stream);
        return error ? error : released;
    }

  private:
    struct Of {
        sgs_cuda_view view;
        Splat* splats = nullptr;
        int32_t *slots = nullptr, *counts = nullptr, *starts = nullptr, *cursors = nullptr, *rows = nullptr;
        int64_t* totals = nullptr;  // entries of lists, and slots
        int64_t slot_count = 0;
        uint64_t* keys = nullptr;
        float *transmittance = nullptr, *sums = nullptr;

        Camera camera() const { return {view.viewmat, view.K, nullptr, view.near_plane, view.width, view.height}; }
        int64_t count() const { return view.gaussians.count + view.statics.count; }
        Tiles lists() const {
            return {nullptr, view.tiles, camera().columns(), view.width, view.height, view.gaussians.count, splats,
                    splats + view.gaussians.count, starts, nullptr, rows, view.background};
        }
    };

    // The lists of all tiles.
    int list() {
        const size_t count = views_.size();
        if (const int error = lay_out(&memory_, [&](Arena& a) {
                counts_ = a.take<int32_t>(all_tiles()), totals_ = a.take<int64_t>(2 * count);
                int32_t* counts = counts_;
                for (size_t n = 0; n < count; ++n) {
                    Of& o = views_[n];
                    const int64_t tiles = o.camera().tiles();
                    o.counts = counts, o.totals = totals_ + 2 * n;
                    if (counts != nullptr) counts += tiles;
                    o.splats = a.take<Splat>(o.count()), o.slots = a.take<int32_t>(o.count());
                    o.starts = a.take<int32_t>(tiles + 1), o.cursors = a.take<int32_t>(tiles);
                    o.transmittance = o.view.alpha;
                    if (o.view.image != nullptr && (differentiable_ || o.view.alpha == nullptr))
                        o.transmittance = a.take<float>(int64_t{o.view.width} * o.view.height);
                }
            }))
            return error;
        if (const int error = fill(counts_, 0, sizeof(int32_t) * all_tiles(), stream_)) return error;
        std::vector<Counted<Project>> projects;
        std::vector<Counted<Starts>> starts;
        for (const Of& o : views_) {
            const sgs_cuda_view& v = o.view;
            const int64_t first = v.gaussians.count;
            projects.push_back({{o.camera(), v.gaussians, v.tiles, o.splats, o.counts, o.slots, v.radii}, first});
            if (v.statics.count > 0) projects.push_back(
                {{o.camera(), v.statics, v.tiles, o.splats + first, o.counts, o.slots + first,
                  v.radii == nullptr ? nullptr : v.radii + first},
                 v.statics.count});
            starts.push_back(
                {{o.counts, o.camera().tiles(), o.starts, o.cursors, first, o.slots, nullptr, nullptr, 0, kMostPairs, nullptr,
                  o.totals, o.totals + 1},
                 1});
        }
        if (const int error = each_element(projects, stream_)) return error;
        if (const int error = each_block(starts, stream_)) return error;
        std::vector<int64_t> totals(2 * count);
        if (const int error = to_host(totals.data(), totals_, sizeof(int64_t) * totals.size(), stream_)) return error;
        if (const int error = wait(stream_)) return error;
        for (const int64_t total : totals)
            if (total > kMostPairs) return kNoMemory;
        if (const int error = lay_out(&pair_memory_, [&](Arena& a) {
                for (size_t n = 0; n < count; ++n) {
                    Of& o = views_[n];
                    o.slot_count = totals[2 * n + 1];
                    o.keys = a.take<uint64_t>(totals[2 * n]), o.rows = a.take<int32_t>(totals[2 * n]);
                    o.sums = a.take<float>(o.slot_count * o.view.channels);
                }
            }))
            return error;
        std::vector<Counted<Scatter>> scatters;
        std::vector<Counted<Sort>> sorts;
        for (const Of& o : views_) {
            scatters.push_back({{nullptr, o.splats, o.view.tiles, o.camera().columns(), o.cursors, o.keys}, o.count()});
            sorts.push_back(
                {{nullptr, o.view.tiles, o.starts, o.keys, nullptr, nullptr, 0, o.rows}, o.camera().tiles()});
        }
        if (const int error = each_element(scatters, stream_)) return error;
        return each_block(sorts, stream_);
    }

    template <typename Layout>
    int lay_out(void** memory, const Layout& layout) {
        Arena sizes(nullptr);
        layout(sizes);
        if (const int error = allocate(memory, sizes.size(), stream_)) return error;
        Arena arena(*memory);
        layout(arena);
        return 0;
    }
    int64_t all_tiles() const {
        int64_t tiles = 0;
        for (const Of& o : views_) tiles += o.camera().tiles();
        return tiles;
    }

    void* stream_;
    bool differentiable_;
    std::vector<Of> views_;
    void *memory_ = nullptr, *pair_memory_ = nullptr;
    int32_t* counts_ = nullptr;
    int64_t* totals_ = nullptr;
};

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream

extern "C" {

int sgs_cuda_views(const sgs_cuda_view* views, int count, void* stream) try {
    return structgstream::cuda::fit::Views(views, count, false, stream).draw();
} catch (const std::bad_alloc&) {
    return structgstream::cuda::fit::kNoMemory;
}

int sgs_cuda_raster_new(const sgs_cuda_view* view, void** raster, void* stream) {
    using structgstream::cuda::fit::Views;
    *raster = nullptr;
    try {
        Views* made = new Views(view, 1, true, stream);
        *raster = made;
        return made->draw();
    } catch (const std::bad_alloc&) {
        return structgstream::cuda::fit::kNoMemory;
    }
}

int sgs_cuda_raster_backward(
    void* raster, const float* image_gradient, const float* alpha_gradient, const sgs_cuda_gradients* gradients,
    void* stream) {
    return static_cast<structgstream::cuda::fit::Views*>(raster)->backward(
        image_gradient, alpha_gradient, *gradients, stream);
}

void sgs_cuda_raster_free(void* raster) { delete static_cast<structgstream::cuda::fit::Views*>(raster); }

int sgs_cuda_reached_tiles(const sgs_cuda_reach* views, int count, void* stream) try {
    using namespace structgstream::cuda::fit;
    std::vector<Counted<Reach>> reaches;
    for (int v = 0; v < count; ++v) reaches.push_back({{views[v]}, views[v].gaussians.count});
    return each_element(reaches, stream);
} catch (const std::bad_alloc&) {
    return structgstream::cuda::fit::kNoMemory;
}

int sgs_cuda_display(const sgs_cuda_display_call* call, void* stream) {
    return structgstream::cuda::for_each(
        structgstream::cuda::Display{*call}, int64_t{call->width} * call->height, stream);
}

}  // extern "C"
