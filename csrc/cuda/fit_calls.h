// SPDX-License-Identifier: Apache-2.0
// The interface of fit.h: the order of an iteration's kernels. fit.cu compiles it for a GPU, emulate_fit.cpp for a CPU.
#pragma once

#include <algorithm>
#include <cmath>
#include <new>
#include <vector>

#include "fit.h"
#include "fit_anchors.h"
#include "fit_memory.h"
#include "fit_raster.h"
#include "fit_update.h"
#include "ssim.h"

namespace structgstream {
namespace cuda {
namespace fit {

// The static Gaussians of a view.
struct StaticSplats {
    sgs_fit_view view;
    Camera camera;
    const uint8_t* drawn;
    Splat* splats;
    int32_t* counts;

    SGS_LANES_FN void operator()(int64_t i) const {
        splats[i] = projected(
            camera, view.means + 3 * i, view.quats + 4 * i, view.scales + 3 * i, view.opacities[i], view.colors + 3 * i,
            view.intervals == nullptr ? nullptr : view.intervals + i);
        count_tiles(splats[i], drawn, camera.columns(), counts);
    }
};

struct EitherTile {
    const uint8_t *tiles, *changed;
    uint8_t* either;
    SGS_ELEMENT void operator()(int64_t i) const { either[i] = tiles[i] || changed[i]; }
};

struct CopyStarts {
    const int32_t* starts;
    int32_t* cursors;
    SGS_ELEMENT void operator()(int64_t i) const { cursors[i] = starts[i]; }
};

class Fit {
  public:
    Fit(const sgs_fit_frame& frame, int64_t slots, void* stream)
        : f_(frame), stream_(stream), capacity_(slots), views_(frame.views, frame.views + frame.view_count) {
        for (const sgs_fit_view& v : views_) {
            pixels_ = std::max(pixels_, int64_t{v.width} * v.height);
            tiles_ = std::max(tiles_, int64_t{camera_of(v).tiles()});
            segments_ = std::max(segments_, int64_t{v.height} * camera_of(v).columns());
        }
        for (const sgs_leaf& leaf : f_.leaves) numbers_ += leaf.first != nullptr ? leaf.count : 0;
        f_.views = views_.data();
        statics_.resize(views_.size());
        Model& m = model_;
        m.anchors = f_.anchors, m.free = f_.free, m.k = f_.offsets_per_anchor, m.d = f_.feature_size;
        m.inputs = m.d + 3 + (f_.distance_input ? 1 : 0), m.hidden = f_.hidden_size, m.rank = f_.basis ? f_.rank : 0;
        m.basis = f_.basis, m.anchor_intervals = f_.anchor_intervals, m.free_intervals = f_.free_intervals;
        for (int h = 0; h < kHeads; ++h) m.heads[h] = f_.heads[h];
    }
    ~Fit() {
        for (void* memory : {memory_, static_memory_, pair_memory_, result_memory_}) release(memory, stream_);
    }
    Fit(const Fit&) = delete;
    Fit& operator=(const Fit&) = delete;

    int begin() {
        Arena sizes(nullptr);
        lay_out(sizes);
        if (const int error = allocate(&memory_, sizes.size(), stream_)) return error;
        Arena arena(memory_);
        lay_out(arena);
        const float weights[2] = {f_.l1, -f_.ssim};
        if (const int error = to_device(loss_weights_, weights, sizeof weights, stream_)) return error;
        if (const int error = reset()) return error;
        return prepare_statics();
    }

    int run(int from, int to) {
        if (const int error = make_room_for_results(to - from)) return error;
        for (int first = from; first < to;) {
            if (pair_memory_ == nullptr)
                if (const int error = make_room_for_pairs()) return error;
            for (int i = first; i < to; ++i)
                if (const int error = iteration(i, i - from)) return error;
            State found;
            if (const int error = to_host(&found, state_, sizeof found, stream_)) return error;
            if (const int error = wait(stream_)) return error;
            if (found.stopped < 0) break;
            if (found.slots > kMostPairs) return kNoMemory;
            first = found.stopped, capacity_ = std::min(found.slots + found.slots / 2, kMostPairs);
            if (const int error = release(pair_memory_, stream_)) return error;
            pair_memory_ = nullptr;
            if (const int error = reset()) return error;
        }
        return read_results(from, to);
    }

  private:
    struct Static {
        Splat* splats;
        int32_t* starts;
        uint8_t* drawn;  // tiles of a full or of a resting visit
        uint64_t* keys;
    };

    static Camera camera_of(const sgs_fit_view& v) {
        return {v.viewmat, v.K, v.center, v.near_plane, v.width, v.height};
    }

    void lay_out(Arena& a) {
        Model& m = model_;
        const int64_t rows = m.rows(), outputs = 11 * m.k;
        for (int n = 0; n < SGS_LEAVES; ++n) {
            const sgs_leaf& leaf = f_.leaves[n];
            rounded_[n] = leaf.step > 0.0f ? a.take<float>(leaf.count) : nullptr;
            m.values[n] = leaf.step > 0.0f ? rounded_[n] : leaf.values;
            m.gradients[n] = leaf.first != nullptr ? a.take<float>(leaf.count) : nullptr;
        }
        m.x = a.take<float>(m.anchors * m.inputs), m.to_x = a.take<float>(kHeads * m.anchors * m.inputs);
        m.h = a.take<float>(kHeads * m.anchors * m.hidden), m.to_h = a.take<float>(kHeads * m.anchors * m.hidden);
        m.out = a.take<float>(m.anchors * outputs), m.to_out = a.take<float>(m.anchors * outputs);
        m.seen = a.take<uint8_t>(m.anchors);
        m.means = a.take<float>(3 * rows), m.quats = a.take<float>(4 * rows), m.scales = a.take<float>(3 * rows);
        m.opacities = a.take<float>(rows), m.colors = a.take<float>(3 * rows), m.inverse_norms = a.take<float>(rows);
        m.to_means = a.take<float>(3 * rows), m.to_scales = a.take<float>(3 * rows);
        m.splats = a.take<Splat>(rows);
        m.slots = slots_ = a.take<int32_t>(rows);
        counts_ = a.take<int32_t>(tiles_), cursors_ = a.take<int32_t>(tiles_), starts_ = a.take<int32_t>(tiles_ + 1);
        state_ = a.take<State>(1);
        totals_ = a.take<int64_t>(f_.view_count);
        transmittance_ = a.take<float>(pixels_), corrected_ = a.take<float>(3 * pixels_);
        to_image_ = a.take<float>(3 * pixels_), adjoints_ = a.take<float>(9 * pixels_);
        loss_sums_ = a.take<float>(2 * tiles_), loss_means_ = a.take<float>(2), loss_weights_ = a.take<float>(2);
        smooth_sums_ = a.take<float>(f_.anchors), smooth_gradients_ = a.take<int64_t>(3 * f_.anchors);
        bits_ = a.take<float>(blocks());
        squares_ = a.take<float>(segments_), square_counts_ = a.take<int32_t>(segments_);
        for (size_t v = 0; v < statics_.size(); ++v) {
            const int64_t tiles = camera_of(views_[v]).tiles();
            statics_[v] = {a.take<Splat>(views_[v].static_count), a.take<int32_t>(tiles + 1), a.take<uint8_t>(tiles), nullptr};
        }
    }

    int64_t blocks() const { return (numbers_ + kUpdateThreads - 1) / kUpdateThreads; }

    // Before the first iteration, and after one that had too few slots.
    int reset() {
        if (const int error = fill(&state_->stopped, 0xff, sizeof state_->stopped, stream_)) return error;
        return fill(counts_, 0, sizeof(int32_t) * tiles_, stream_);
    }

    int prepare_statics() {
        for (size_t v = 0; v < statics_.size(); ++v) {
            const Static& s = statics_[v];
            const Camera camera = camera_of(views_[v]);
            const int64_t tiles = camera.tiles(), count = views_[v].static_count;
            if (const int error = for_each(EitherTile{views_[v].tiles, views_[v].changed, s.drawn}, tiles, stream_))
                return error;
            const StaticSplats project = {views_[v], camera, s.drawn, s.splats, counts_};
            if (const int error = for_each(project, count, stream_)) return error;
            const Starts starts = {counts_, tiles, s.starts, cursors_, 0, nullptr, nullptr, nullptr, 0, 0, nullptr,
                                   totals_ + v, nullptr};
            if (const int error = for_blocks(starts, 1, stream_)) return error;
        }
        std::vector<int64_t> totals(statics_.size());
        if (const int error = to_host(totals.data(), totals_, sizeof(int64_t) * totals.size(), stream_)) return error;
        if (const int error = wait(stream_)) return error;
        int64_t total = 0;
        for (int64_t found : totals) total += found, static_pairs_ = std::max(static_pairs_, found);
        if (const int error = allocate(&static_memory_, sizeof(uint64_t) * total, stream_)) return error;
        uint64_t* keys = static_cast<uint64_t*>(static_memory_);
        for (size_t v = 0; v < statics_.size(); keys += totals[v], ++v) {
            Static& s = statics_[v];
            const Camera camera = camera_of(views_[v]);
            s.keys = keys;
            if (const int error = to_cursors(s, camera.tiles())) return error;
            const Scatter scatter = {nullptr, s.splats, s.drawn, camera.columns(), cursors_, s.keys};
            if (const int error = for_each(scatter, views_[v].static_count, stream_)) return error;
            const Sort sort = {nullptr, s.drawn, s.starts, s.keys, nullptr, nullptr, 0, nullptr};
            if (const int error = for_blocks(sort, camera.tiles(), stream_)) return error;
        }
        return 0;
    }

    int to_cursors(const Static& s, int64_t tiles) { return for_each(CopyStarts{s.starts, cursors_}, tiles, stream_); }

    int make_room_for_pairs() {
        Arena sizes(nullptr);
        lay_out_pairs(sizes);
        if (const int error = allocate(&pair_memory_, sizes.size(), stream_)) return error;
        Arena arena(pair_memory_);
        lay_out_pairs(arena);
        return 0;
    }
    void lay_out_pairs(Arena& a) {
        keys_ = a.take<uint64_t>(capacity_), merged_ = a.take<int32_t>(capacity_ + static_pairs_);
        moments_ = a.take<float>(kMoments * capacity_);
    }

    int make_room_for_results(int count) {
        if (const int error = release(result_memory_, stream_)) return error;
        result_memory_ = nullptr;
        if (const int error = allocate(&result_memory_, count * (sizeof(double) + kTerms * sizeof(float)), stream_))
            return error;
        squared_errors_ = static_cast<double*>(result_memory_);
        terms_ = reinterpret_cast<float*>(squared_errors_ + count);
        return 0;
    }
    int read_results(int from, int to) {
        const size_t count = to - from, errors_from = std::max(0, f_.errors_from - from);
        if (const int error = to_host(f_.terms + kTerms * from, terms_, sizeof(float) * kTerms * count, stream_))
            return error;
        if (errors_from < count)
            if (const int error = to_host(
                    f_.squared_errors + from + errors_from, squared_errors_ + errors_from,
                    sizeof(double) * (count - errors_from), stream_))
                return error;
        return wait(stream_);
    }

    // Iteration i, whose results are the n-th of the run.
    int iteration(int i, int n) {
        const sgs_fit_view& v = views_[f_.order[i]];
        const Static& still = statics_[f_.order[i]];
        const uint8_t* drawn = f_.rests[i] ? v.changed : v.tiles;
        const Camera camera = camera_of(v);
        const Tiles tiles = {state_, drawn, camera.columns(), v.width, v.height, model_.rows(), model_.splats, still.splats,
                             starts_, still.starts, merged_, v.background};
        if (const int error = generate(v, camera, drawn, i)) return error;
        const Scatter scatter = {state_, model_.splats, drawn, camera.columns(), cursors_, keys_};
        if (const int error = for_each(scatter, model_.rows(), stream_)) return error;
        const Sort sort = {state_, drawn, starts_, keys_, still.starts, still.keys, model_.rows(), merged_};
        if (const int error = for_blocks(sort, camera.tiles(), stream_)) return error;
        if (const int error = for_blocks(Draw{tiles, v.image, transmittance_}, camera.tiles(), stream_)) return error;
        if (const int error = compare(v, drawn)) return error;
        const DrawBackward backward = {tiles, slots_, v.image, transmittance_, to_image_, nullptr, moments_};
        if (const int error = for_blocks(backward, camera.tiles(), stream_)) return error;
        if (const int error = generate_backward(camera, drawn)) return error;
        if (const int error = update(i)) return error;
        return report(v, i, n);
    }

    int generate(const sgs_fit_view& v, const Camera& camera, const uint8_t* drawn, int i) {
        Round round = {};
        int64_t numbers = 0;
        for (int n = 0; n < SGS_LEAVES; ++n)
            if (rounded_[n] != nullptr && f_.leaves[n].count > 0)
                round.parts[round.count++] = {
                    f_.leaves[n].values, rounded_[n], numbers += f_.leaves[n].count, f_.leaves[n].step};
        if (const int error = for_each(round, numbers, stream_)) return error;
        const Model& m = model_;
        const Seen seen = {
            m.values[kPositions], m.values[kOffsetScales], m.values[kBaseScales], m.values[kOffsets], m.anchor_intervals,
            m.k, v.viewmat, v.K, {v.width, v.height}, v.near_plane, drawn, m.seen};
        if (const int error = for_each<kAnchorThreads>(AnchorInputs{m, seen, v.center}, m.anchors, stream_)) return error;
        if (const int error = for_each<kAnchorThreads>(AnchorHead{m}, kHeads * m.anchors, stream_)) return error;
        if (const int error = for_each<kAnchorThreads>(DecodeGaussians{m, camera, drawn, counts_}, m.rows(), stream_)) return error;
        const Starts starts = {counts_, camera.tiles(), starts_, cursors_, m.rows(), slots_,
                               f_.volume == 0.0f ? nullptr : m.scales, m.opacities, i, capacity_, state_, nullptr, nullptr};
        return for_blocks(starts, 1, stream_);
    }

    int compare(const sgs_fit_view& v, const uint8_t* drawn) {
        const float *image = v.image, *gains = v.gains, *biases = v.biases;
        const int64_t numbers = int64_t{3} * v.width * v.height;
        if (v.mask != nullptr) {  // Both pictures are black where the mask is zero.
            const Correct correct = {v.mask, gains, biases, image, corrected_};
            if (const int error = for_each(correct, numbers, stream_)) return error;
            image = corrected_, gains = biases = nullptr;
        }
        if (const int error = sgs_cuda_l1_ssim(
                image, nullptr, v.picture, v.height, v.width, gains, biases, drawn, adjoints_, loss_sums_, loss_means_,
                stream_))
            return error;
        if (const int error = sgs_cuda_l1_ssim_backward(
                image, nullptr, v.picture, v.height, v.width, gains, biases, drawn, adjoints_, loss_weights_,
                loss_weights_ + 1, to_image_, stream_))
            return error;
        return v.mask == nullptr ? 0 : for_each(CorrectBackward{v.mask, v.gains, to_image_}, numbers, stream_);
    }

    int generate_backward(const Camera& camera, const uint8_t* drawn) {
        const Model& m = model_;
        const DecodeGaussiansBackward decode = {m, camera, state_, drawn, slots_, moments_, f_.volume, f_.mean_volume != 0};
        if (const int error = for_each<kAnchorThreads>(decode, m.rows(), stream_)) return error;
        if (m.trains_inputs())
            if (const int error = for_each<kAnchorThreads>(AnchorHeadBackward{m, state_}, kHeads * m.anchors, stream_))
                return error;
        return for_each<kAnchorThreads>(AnchorBackward{m, state_, camera.center}, m.anchors, stream_);
    }

    bool smooth() const { return f_.neighbour_count > 0; }

    int update(int i) {
        if (smooth()) {
            if (const int error = fill(smooth_gradients_, 0, sizeof(int64_t) * 3 * f_.anchors, stream_)) return error;
            const Smooth smoothness = {state_, f_.leaves[kPositions].values, f_.start, f_.neighbours, f_.shares,
                                       f_.neighbour_count, f_.pixel, f_.slack, smooth_sums_, smooth_gradients_};
            if (const int error = for_each<kAnchorThreads>(smoothness, f_.anchors, stream_)) return error;
        }
        Update update = {};
        update.state = state_, update.smoothness = smooth_gradients_, update.rate = f_.rate, update.bits = bits_;
        update.smooth_factor = f_.smoothness / static_cast<float>(f_.anchors) / f_.pixel;
        update.beta1 = static_cast<float>(f_.beta1), update.rest1 = static_cast<float>(1.0 - f_.beta1);
        update.beta2 = static_cast<float>(f_.beta2), update.rest2 = static_cast<float>(1.0 - f_.beta2);
        const double decay1 = 1.0 - std::pow(f_.beta1, i + 1.0), decay2 = 1.0 - std::pow(f_.beta2, i + 1.0);
        update.correction = static_cast<float>(1.0 / std::sqrt(decay2)), update.eps = static_cast<float>(f_.eps);
        update.sums = i >= f_.mean_from;
        int64_t numbers = 0;
        for (int n = 0; n < SGS_LEAVES; ++n) {
            const sgs_leaf& leaf = f_.leaves[n];
            if (leaf.first == nullptr || leaf.count == 0) continue;
            const double rate = f_.rates[SGS_LEAVES * i + n];
            update.parts[update.count++] = {leaf, model_.gradients[n], numbers += leaf.count,
                                            static_cast<float>(rate / decay1), rate > 0.0, smooth() && n == kPositions};
        }
        return for_blocks(update, blocks(), stream_);
    }

    int report(const sgs_fit_view& v, int i, int n) {
        const Camera camera = camera_of(v);
        const int64_t segments = int64_t{v.height} * camera.columns();
        const bool squares = i >= f_.errors_from;
        if (squares) {
            const SquaredErrors errors = {state_, v.tiles, v.mask, v.gains, v.biases, v.image, v.picture, camera.columns(),
                                          v.width, squares_, square_counts_};
            if (const int error = for_each(errors, segments, stream_)) return error;
        }
        const Report report = {state_, loss_means_, bits_, blocks(), smooth() ? smooth_sums_ : nullptr, f_.anchors,
                               squares ? squares_ : nullptr, square_counts_, segments, f_.l1, f_.ssim, f_.volume,
                               f_.smoothness, f_.rate, f_.mean_volume != 0, terms_ + kTerms * n, squared_errors_ + n};
        return for_blocks(report, 1, stream_);
    }

    static constexpr int kAnchorThreads = 64;  // there are few anchors for many multiprocessors

    sgs_fit_frame f_;
    void* stream_;
    int64_t capacity_, pixels_ = 0, tiles_ = 0, segments_ = 0, numbers_ = 0, static_pairs_ = 0;
    std::vector<sgs_fit_view> views_;
    std::vector<Static> statics_;
    void *memory_ = nullptr, *static_memory_ = nullptr, *pair_memory_ = nullptr, *result_memory_ = nullptr;
    Model model_ = {};
    float* rounded_[SGS_LEAVES] = {};
    int32_t *slots_ = nullptr, *counts_ = nullptr, *cursors_ = nullptr, *starts_ = nullptr, *merged_ = nullptr,
            *square_counts_ = nullptr;
    State* state_ = nullptr;
    int64_t *totals_ = nullptr, *smooth_gradients_ = nullptr;
    uint64_t* keys_ = nullptr;
    float *transmittance_ = nullptr, *corrected_ = nullptr, *to_image_ = nullptr, *adjoints_ = nullptr,
          *loss_sums_ = nullptr, *loss_means_ = nullptr, *loss_weights_ = nullptr, *smooth_sums_ = nullptr,
          *bits_ = nullptr, *squares_ = nullptr, *moments_ = nullptr, *terms_ = nullptr;
    double* squared_errors_ = nullptr;
};

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream

extern "C" {

int sgs_cuda_fit_new(const sgs_fit_frame* frame, int64_t slots, void* stream, void** fit) {
    using structgstream::cuda::fit::Fit;
    *fit = nullptr;
    try {
        Fit* made = new Fit(*frame, slots, stream);
        *fit = made;
        return made->begin();
    } catch (const std::bad_alloc&) {
        return structgstream::cuda::fit::kNoMemory;
    }
}

int sgs_cuda_fit_run(void* fit, int from, int to) { return static_cast<structgstream::cuda::fit::Fit*>(fit)->run(from, to); }

void sgs_cuda_fit_free(void* fit) { delete static_cast<structgstream::cuda::fit::Fit*>(fit); }

}  // extern "C"
