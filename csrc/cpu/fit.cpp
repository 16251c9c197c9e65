// SPDX-License-Identifier: Apache-2.0
// The iterations of a later frame, as training/online/iterations.py has them in torch: generate, project, bin, draw, compare, and
// back; the rate term and motion smoothness; Adam; sums for the mean of the last ones. Their order and the order of
// all sums is that of the torch loop.

#include <algorithm>
#include <cmath>
#include <memory>
#include <new>
#include <vector>

#include "bin.h"
#include "draw.h"
#include "structgstream.h"

namespace structgstream {
namespace {

enum Leaf {
    kPositions, kOffsetScales, kBaseScales, kOffsets, kFeatures, kAppearance,
    kFreeMeans, kFreeScales, kFreeQuats, kFreeOpacities, kFreeColors
};
constexpr int kTerms = 5;

using Floats = std::vector<float>;

// Attributes of Gaussians, or their gradients.
struct Columns {
    Floats means, quats, scales, opacities, colors;
    void resize(size_t rows) {
        means.resize(3 * rows), quats.resize(4 * rows), scales.resize(3 * rows), opacities.resize(rows);
        colors.resize(3 * rows);
    }
};

// Number of pixels in the tiles.
int64_t pixels_in(const uint8_t* tiles, const sgs_fit_view& v) {
    int64_t found = 0;
    for (int y = 0; y < v.height; y += kTile)
        for (int x = 0; x < v.width; x += kTile)
            if (*tiles++) found += std::min(kTile, v.height - y) * std::min(kTile, v.width - x);
    return found;
}

class Fit {
  public:
    explicit Fit(const sgs_fit_frame& frame) : f_(frame) {
        int64_t pixels = 0, statics = 0;
        for (const sgs_fit_view* v = f_.views; v != f_.views + f_.view_count; ++v) {
            pixels = std::max(pixels, int64_t{v->width} * v->height);
            statics = std::max(statics, v->static_count);
        }
        statics_.resize(2 * f_.view_count);
        const size_t m = f_.anchors, structured = m * f_.offsets_per_anchor, dynamic = structured + f_.free;
        drawn_.resize(dynamic), to_drawn_.resize(dynamic);
        intervals_.resize(f_.anchor_intervals ? dynamic : 0);
        radii_.resize(std::max<size_t>(dynamic, statics));
        ids_.resize(structured), norms_.resize(structured);
        visible_.resize(m), active_.resize(m), starts_.resize(m + 1);
        raw_.resize(structured), bits_.resize(3 * m * ((f_.hidden_size + 31) / 32));
        alpha_.resize(pixels), ssim_gradient_.resize(3 * pixels), to_image_.resize(3 * pixels);
        for (int i = 0; i < SGS_LEAVES; ++i) {
            const sgs_leaf& leaf = f_.leaves[i];
            if (leaf.step > 0.0f) rounded_[i].resize(leaf.count);
            if (leaf.first) gradients_[i].resize(leaf.count);
        }
        if (f_.basis) folded_.resize(m * f_.feature_size), to_folded_.resize(m * f_.feature_size);
        if (f_.neighbour_count) moved_.resize(3 * m), to_moved_.resize(3 * m);
    }

    void run(int i, int threads) {
        threads_ = threads;
        view_ = &f_.views[f_.order[i]];
        tiles_ = f_.rests[i] ? view_->changed : view_->tiles;
        terms_ = f_.terms + kTerms * i;
        quantize();
        generate();
        draw();
        compare();
        if (i >= f_.errors_from) f_.squared_errors[i] = squared_error();
        draw_backward();
        generate_backward();
        add_regularizers();
        update(i);
    }

  private:
    const float* value(int leaf) const {
        return rounded_[leaf].empty() ? f_.leaves[leaf].values : rounded_[leaf].data();
    }

    void quantize() {
        constexpr float kMagic = 12582912.0f;  // rounds to an integer, ties to even, what is below 2^22
        for (int n = 0; n < SGS_LEAVES; ++n) {
            const float step = f_.leaves[n].step, *values = f_.leaves[n].values;
            for (size_t i = 0; i < rounded_[n].size(); ++i) rounded_[n][i] = ((values[i] / step + kMagic) - kMagic) * step;
        }
    }

    void generate() {
        const int k = f_.offsets_per_anchor;
        const float* features = value(kFeatures);
        if (f_.basis) {
            fold_appearance(
                features, value(kAppearance), f_.basis, f_.anchors, f_.feature_size, f_.rank, folded_.data());
            features = folded_.data();
        }
        anchors_ = {value(kPositions), value(kOffsetScales), value(kBaseScales), value(kOffsets), features,
                    visible_.data(), {f_.heads[0], f_.heads[1], f_.heads[2]}, {}, 0, k, f_.feature_size, f_.hidden_size,
                    f_.distance_input};
        std::copy_n(view_->center, 3, anchors_.camera_center);
        const int64_t seen = sgs_anchors_visible(
            &anchors_, f_.anchors, f_.anchor_intervals, view_->viewmat, view_->K, view_->width, view_->height,
            view_->near_plane, tiles_, visible_.data(), threads_);
        if (seen < 0) throw std::bad_alloc();
        anchors_.visible_count = static_cast<int32_t>(seen);
        selection_ = {raw_.data(), bits_.data(), active_.data(), starts_.data(), 0, 0};
        sgs_anchors_select(&anchors_, &selection_, threads_);
        structured_ = selection_.gaussian_count;
        const sgs_gaussians out = gaussians();
        sgs_anchors_dress(&anchors_, &selection_, &out, threads_);
        if (f_.anchor_intervals)
            for (int64_t i = 0; i < structured_; ++i) intervals_[i] = f_.anchor_intervals[ids_[i] / k];
        add_free();
        dynamic_ = structured_ + f_.free;
    }

    sgs_gaussians gaussians() {
        return {drawn_.means.data(),  drawn_.quats.data(), drawn_.scales.data(), drawn_.opacities.data(),
                drawn_.colors.data(), ids_.data(),         norms_.data()};
    }

    void add_free() {
        const int64_t at = structured_, count = f_.free;
        std::copy_n(value(kFreeMeans), 3 * count, drawn_.means.data() + 3 * at);
        std::copy_n(value(kFreeQuats), 4 * count, drawn_.quats.data() + 4 * at);
        std::copy_n(value(kFreeColors), 3 * count, drawn_.colors.data() + 3 * at);
        for (int64_t i = 0; i < 3 * count; ++i) drawn_.scales[3 * at + i] = std::exp(value(kFreeScales)[i]);
        for (int64_t i = 0; i < count; ++i)
            drawn_.opacities[at + i] = 1.0f / (1.0f + std::exp(-value(kFreeOpacities)[i]));
        if (f_.anchor_intervals) std::copy_n(f_.free_intervals, count, intervals_.data() + at);
    }

    GaussianInputs inputs() const {
        return {drawn_.means.data(),  drawn_.quats.data(), drawn_.scales.data(), drawn_.opacities.data(),
                drawn_.colors.data(), nullptr,             f_.anchor_intervals ? intervals_.data() : nullptr, dynamic_};
    }

    // The static splats that reach the tiles: found in the first visit of the view that draws these tiles.
    const std::vector<Splat>& statics() {
        const sgs_fit_view& v = *view_;
        Statics& found = statics_[2 * (view_ - f_.views) + (tiles_ == v.changed)];
        if (!found.known) {
            raster_.splats.resize(v.static_count);
            project(
                {v.means, v.quats, v.scales, v.opacities, v.colors, nullptr, v.intervals, v.static_count}, raster_,
                radii_.data(), threads_);
            for (const Splat& splat : raster_.splats)
                if (splat.box[0] < splat.box[2]) found.splats.push_back(splat);
            found.known = true;
        }
        return found.splats;
    }

    void draw() {
        look(raster_, view_->viewmat, view_->K, view_->width, view_->height, view_->near_plane, tiles_);
        raster_.trained = dynamic_;
        const std::vector<Splat>& at_rest = statics();
        raster_.splats.resize(dynamic_ + at_rest.size());
        project(inputs(), raster_, radii_.data(), threads_);
        std::copy(at_rest.begin(), at_rest.end(), raster_.splats.begin() + dynamic_);
        bin(raster_);
        rasterize(raster_, view_->background, view_->image, alpha_.data(), threads_);
    }

    void compare() {
        const sgs_fit_view& v = *view_;
        const int64_t pixels = int64_t{v.width} * v.height;
        const float *image = v.image, *gains = v.gains, *biases = v.biases;
        if (v.mask) {  // Both pictures are black where the mask is zero.
            corrected_.resize(3 * pixels);
            for (int64_t i = 0; i < 3 * pixels; ++i) {
                corrected_[i] = v.mask[i / 3] ? image[i] * gains[i % 3] + biases[i % 3] : 0.0f;
            }
            image = corrected_.data(), gains = biases = nullptr;
        }
        rows_.resize(2 * v.height);
        double *l1_rows = rows_.data(), *ssim_rows = l1_rows + v.height;
        sgs_l1_ssim(
            image, nullptr, v.picture, v.height, v.width, gains, biases, tiles_, ssim_gradient_.data(), l1_rows, ssim_rows,
            threads_);
        double l1 = 0.0, ssim = 0.0;
        for (int y = 0; y < v.height; ++y) l1 += l1_rows[y], ssim += ssim_rows[y];
        const double numbers = 3.0 * pixels;
        terms_[0] = static_cast<float>(l1 / numbers);
        terms_[1] = 1.0f - static_cast<float>((ssim + numbers - 3.0 * pixels_in(tiles_, v)) / numbers);
        terms_[4] = f_.l1 * terms_[0] + f_.ssim * terms_[1];
        sgs_l1_ssim_backward(
            image, nullptr, v.picture, v.height, v.width, gains, biases, tiles_, ssim_gradient_.data(),
            static_cast<float>(f_.l1 / numbers), -f_.ssim, to_image_.data(), threads_);
        if (v.mask)
            for (int64_t i = 0; i < 3 * pixels; ++i) to_image_[i] = v.mask[i / 3] ? to_image_[i] * v.gains[i % 3] : 0.0f;
    }

    // Mean squared error of the clamped picture over all tiles of the view, as they were drawn last.
    double squared_error() const {
        const sgs_fit_view& v = *view_;
        double total = 0.0;
        int64_t counted = 0;
        const int across = (v.width + kTile - 1) / kTile;
        for (int y = 0; y < v.height; ++y) {
            float row = 0.0f;
            for (int x = 0; x < v.width; ++x) {
                const int64_t pixel = int64_t{y} * v.width + x;
                if (!v.tiles[y / kTile * across + x / kTile] || (v.mask && !v.mask[pixel])) continue;
                ++counted;
                for (int c = 0; c < 3; ++c) {
                    const float shown = v.image[3 * pixel + c] * v.gains[c] + v.biases[c];
                    const float apart = std::min(std::max(shown, 0.0f), 1.0f) - v.picture[3 * pixel + c] / 255.0f;
                    row += apart * apart;
                }
            }
            total += row;
        }
        return total / (3.0 * std::max<int64_t>(counted, 1));
    }

    void draw_backward() {
        moments_.resize(static_cast<size_t>(raster_.slots[dynamic_]) * kMomentCount);
        rasterize_backward(
            raster_, view_->background, view_->image, alpha_.data(), to_image_.data(), nullptr, moments_.data(), threads_);
        project_backward(
            inputs(), raster_, moments_.data(),
            {to_drawn_.means.data(), to_drawn_.quats.data(), to_drawn_.scales.data(), to_drawn_.opacities.data(),
             to_drawn_.colors.data(), nullptr},
            threads_);
        if (f_.volume == 0.0f) return;
        int64_t visible = 0;
        const float* scales = drawn_.scales.data();
        const float total = static_cast<float>(sgs_volume(scales, drawn_.opacities.data(), dynamic_, &visible));
        const float count = f_.mean_volume ? static_cast<float>(std::max<int64_t>(visible, 1)) : 1.0f;
        terms_[2] = total / count;
        terms_[4] += f_.volume * terms_[2];
        const float factor = f_.volume / count;
        for (int64_t i = 0; i < 3 * dynamic_; i += 3) {
            const float x = scales[i], y = scales[i + 1], z = scales[i + 2];
            to_drawn_.scales[i] += factor * y * z;
            to_drawn_.scales[i + 1] += factor * x * z;
            to_drawn_.scales[i + 2] += factor * x * y;
        }
    }

    // The memory of a leaf's gradient, null if it is not trained.
    float* gradient(int leaf) { return f_.leaves[leaf].first ? gradients_[leaf].data() : nullptr; }

    void generate_backward() {
        const bool folds = f_.basis && (gradient(kAppearance) || gradient(kFeatures));
        const sgs_gaussian_gradients from{
            to_drawn_.means.data(), to_drawn_.quats.data(), to_drawn_.scales.data(), to_drawn_.opacities.data(),
            to_drawn_.colors.data()};
        const sgs_anchor_gradients to{
            f_.anchors, gradient(kPositions), gradient(kOffsetScales), gradient(kBaseScales), gradient(kOffsets),
            folds ? to_folded_.data() : gradient(kFeatures), {}};
        const sgs_gaussians drawn = gaussians();
        sgs_anchors_backward(&anchors_, &selection_, &drawn, &from, &to, threads_);
        if (folds && gradient(kFeatures)) gradients_[kFeatures] = to_folded_;
        if (folds && gradient(kAppearance))
            fold_appearance_backward(
                to_folded_.data(), f_.basis, f_.anchors, f_.feature_size, f_.rank, gradient(kAppearance));
        const int64_t at = structured_, count = f_.free;
        if (float* out = gradient(kFreeMeans)) std::copy_n(to_drawn_.means.data() + 3 * at, 3 * count, out);
        if (float* out = gradient(kFreeQuats)) std::copy_n(to_drawn_.quats.data() + 4 * at, 4 * count, out);
        if (float* out = gradient(kFreeColors)) std::copy_n(to_drawn_.colors.data() + 3 * at, 3 * count, out);
        if (float* out = gradient(kFreeScales))
            for (int64_t i = 3 * at; i < 3 * (at + count); ++i) *out++ = to_drawn_.scales[i] * drawn_.scales[i];
        if (float* out = gradient(kFreeOpacities))
            for (int64_t i = at; i < at + count; ++i) {
                const float value = drawn_.opacities[i];
                *out++ = to_drawn_.opacities[i] * (1.0f - value) * value;
            }
    }

    void add_regularizers() {
        const bool smooth = f_.neighbour_count > 0;
        const float* positions = f_.leaves[kPositions].values;
        if (smooth) {
            const int64_t numbers = 3 * f_.anchors;
            for (int64_t i = 0; i < numbers; ++i) moved_[i] = (positions[i] - f_.start[i]) / f_.pixel;
            std::fill(to_moved_.begin(), to_moved_.end(), 0.0f);
            const double total = sgs_neighbour_difference(
                moved_.data(), f_.neighbours, f_.shares, f_.anchors, f_.neighbour_count, f_.slack, to_moved_.data());
            terms_[3] = static_cast<float>(total) / static_cast<float>(f_.anchors);
            terms_[4] += f_.smoothness * terms_[3];
            const float factor = f_.smoothness / static_cast<float>(f_.anchors);
            for (int64_t i = 0; i < numbers; ++i) to_moved_[i] = to_moved_[i] * factor / f_.pixel;
        }
        double bits = 0.0;
        for (int n = 0; n < SGS_LEAVES; ++n) {
            const sgs_leaf& leaf = f_.leaves[n];
            if (!leaf.first) continue;
            regularizer_.assign(leaf.count, 0.0f);
            if (leaf.before) {
                bits += sgs_change_bits(leaf.values, leaf.before, leaf.before_count, leaf.step, regularizer_.data());
                for (int64_t i = 0; i < leaf.before_count; ++i) regularizer_[i] *= f_.rate;
            }
            if (n == kPositions && smooth)
                for (int64_t i = 0; i < leaf.count; ++i) regularizer_[i] += to_moved_[i];
            for (int64_t i = 0; i < leaf.count; ++i) gradients_[n][i] += regularizer_[i];
        }
        terms_[4] += f_.rate * static_cast<float>(bits);
    }

    void update(int i) {
        for (int n = 0; n < SGS_LEAVES; ++n) {
            const sgs_leaf& leaf = f_.leaves[n];
            const double rate = f_.rates[SGS_LEAVES * i + n];
            if (leaf.first && leaf.count && rate > 0.0)
                sgs_adam_step(
                    leaf.values, gradients_[n].data(), leaf.first, leaf.second, leaf.count, rate, i + 1, f_.beta1, f_.beta2,
                    f_.eps, threads_);
            if (leaf.sums && i >= f_.mean_from)
                for (int64_t j = 0; j < leaf.count; ++j) leaf.sums[j] += leaf.values[j];
        }
    }

    const sgs_fit_frame f_;
    int threads_ = 1;
    // Of the iteration.
    const sgs_fit_view* view_ = nullptr;
    const uint8_t* tiles_ = nullptr;
    float* terms_ = nullptr;
    int64_t structured_ = 0, dynamic_ = 0;  // anchors' Gaussians, and all with the free ones
    sgs_anchors anchors_;
    sgs_selection selection_;
    Raster raster_;
    struct Statics {
        bool known = false;
        std::vector<Splat> splats;
    };
    std::vector<Statics> statics_;  // by view, in full visits and in resting ones
    // Memory of an iteration, the same in all.
    Floats rounded_[SGS_LEAVES], gradients_[SGS_LEAVES];
    Columns drawn_, to_drawn_;
    Floats folded_, to_folded_, intervals_, radii_, norms_, raw_, alpha_, ssim_gradient_, to_image_, corrected_, moments_, moved_,
        to_moved_, regularizer_;
    std::vector<double> rows_;
    std::vector<int32_t> bits_, active_;
    std::vector<int64_t> ids_, visible_, starts_;
};

}  // namespace
}  // namespace structgstream

extern "C" {

void* sgs_fit_new(const sgs_fit_frame* frame) {
    try {
        return new structgstream::Fit(*frame);
    } catch (const std::bad_alloc&) {
        return nullptr;
    }
}

int sgs_fit_run(void* fit, int from, int to, int threads) {
    try {
        for (int i = from; i < to; ++i) static_cast<structgstream::Fit*>(fit)->run(i, threads);
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

void sgs_fit_free(void* fit) { delete static_cast<structgstream::Fit*>(fit); }

}  // extern "C"
