// SPDX-License-Identifier: Apache-2.0
// Anchors to drawable Gaussians and back (paper, equations for mu' and Sigma'; Scaffold-GS's three heads).
//
// Lanes are anchors: a block of two vectors of anchors passes through the MLPs, whose weights are broadcast. A first
// pass computes the opacities, which determine the number of Gaussians; a second pass computes the attributes of anchors
// with at least one Gaussian. The backward pass needs one bit per hidden unit from the forward pass and recomputes the
// hidden values of the trained heads. Weight gradients are sums over anchors: dot products of rows of a chunk, summed
// chunk by chunk within a fixed number of groups and then group by group, so the result does not depend on threads.

#include "anchors.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "vec.h"

namespace structgstream {
namespace SGS_ISA {
namespace {

constexpr int kBlock = 2 * kLanes;                   // anchors that pass through the MLPs together
constexpr int kTile = kLanes == 16 ? 8 : 4;          // outputs that share the loads of an input
constexpr int kRows = 8;                             // rows are padded to a multiple of this
constexpr int kChunk = 256;                          // anchors, a multiple of every block
constexpr int kChunkBlocks = kChunk / kBlock;
constexpr int kGroups = 64;                          // partial sums of the weights' gradients
constexpr int kHeads = 3;
constexpr int kOutputs[kHeads] = {1, 3, 7};          // for each offset

constexpr int padded(int rows) { return (rows + kRows - 1) / kRows * kRows; }

struct Sizes {
    int k, d, inputs, hidden, inputs_padded, hidden_padded, words;
    int outputs[kHeads], outputs_padded[kHeads];
    explicit Sizes(const sgs_anchors& a)
        : k(a.offsets_per_anchor), d(a.feature_size), inputs(d + 3 + (a.distance_input ? 1 : 0)), hidden(a.hidden_size),
          inputs_padded(padded(inputs)), hidden_padded(padded(hidden)), words((hidden + 31) / 32) {
        for (int h = 0; h < kHeads; ++h) {
            outputs[h] = kOutputs[h] * k;
            outputs_padded[h] = padded(outputs[h]);
        }
    }
};

// A weight matrix in the order in which `apply` reads it: tiles of kTile outputs, in a tile one input after another.
// A std::vector is not used: its functions that are not inlined would be shared between instruction sets.
class Packed {
  public:
    template <typename Weight>
    Packed(int outputs, int inputs, const float* bias, Weight weight)
        : tiles_(padded(outputs) / kTile), inputs_(inputs),
          memory_(static_cast<size_t>(tiles_) * kTile * (inputs + 1)) {
        float* w = memory_.get();
        for (int t = 0; t < tiles_ * kTile; t += kTile)
            for (int i = 0; i < inputs; ++i)
                for (int o = t; o < t + kTile; ++o) *w++ = o < outputs ? weight(o, i) : 0.0f;
        for (int o = 0; o < tiles_ * kTile; ++o) *w++ = o < outputs && bias != nullptr ? bias[o] : 0.0f;
    }
    // y = W x + b for one block; rows of x and y are kBlock floats.
    [[gnu::noinline]] void apply(const float* x, float* y) const {
        const float* w = memory_.get();
        const float* bias = w + static_cast<size_t>(tiles_) * kTile * inputs_;
        for (int t = 0; t < tiles_; ++t) {
            vf sums[kTile][2];
#pragma GCC unroll 8
            for (int o = 0; o < kTile; ++o) sums[o][0] = sums[o][1] = splat(bias[t * kTile + o]);
            for (int i = 0; i < inputs_; ++i, w += kTile) {
                const vf x0 = load(x + i * kBlock), x1 = load(x + i * kBlock + kLanes);
#pragma GCC unroll 8
                for (int o = 0; o < kTile; ++o) {
                    sums[o][0] += splat(w[o]) * x0;
                    sums[o][1] += splat(w[o]) * x1;
                }
            }
#pragma GCC unroll 8
            for (int o = 0; o < kTile; ++o) {
                store(y + (t * kTile + o) * kBlock, sums[o][0]);
                store(y + (t * kTile + o) * kBlock + kLanes, sums[o][1]);
            }
        }
    }

  private:
    int tiles_, inputs_;
    Buffer memory_;
};

Packed first_layer(const sgs_head& head, const Sizes& s) {
    return Packed(s.hidden, s.inputs, head.b1, [&](int o, int i) { return head.w1[o * s.inputs + i]; });
}

Packed second_layer(const sgs_head& head, const Sizes& s, int h) {
    return Packed(s.outputs[h], s.hidden_padded, head.b2, [&](int o, int i) {
        return i < s.hidden ? head.w2[o * s.hidden + i] : 0.0f;
    });
}

Packed second_layer_backwards(const sgs_head& head, const Sizes& s, int h) {
    return Packed(s.hidden, s.outputs[h], nullptr, [&](int o, int i) { return head.w2[i * s.hidden + o]; });
}

// hidden = max(hidden, 0); bits[word * kBlock + lane] has a bit for each positive unit.
void rectify(float* hidden, int count, int32_t* bits, int words) {
    for (int half = 0; half < kBlock; half += kLanes) {
        for (int word = 0; word < words; ++word) {
            vi found = {};
            for (int n = 32 * word; n < std::min(count, 32 * word + 32); ++n) {
                float* row = hidden + n * kBlock + half;
                const vf value = load(row);
                const vi on = value > 0.0f;
                store(row, (vf)((vi)value & on));
                found |= on & static_cast<int32_t>(1u << (n & 31));
            }
            store(bits + word * kBlock + half, found);
        }
    }
}

// Clears the gradient of the units that were off.
void mask(float* gradient, int count, const int32_t* bits) {
    for (int half = 0; half < kBlock; half += kLanes) {
        for (int n = 0; n < count; ++n) {
            float* row = gradient + n * kBlock + half;
            const vi on = (load(bits + (n / 32) * kBlock + half) & static_cast<int32_t>(1u << (n & 31))) != 0;
            store(row, (vf)((vi)load(row) & on));
        }
    }
}

// The anchors of a block. Lanes beyond `count` repeat the last anchor and are not written.
struct Block {
    int count;
    int64_t anchors[kBlock];
};

// Rows of `values` (`width` floats for each anchor) as rows of lanes.
void read_rows(const float* values, int width, const Block& block, float* rows) {
    int column = 0;
    for (; column + kLanes <= width; column += kLanes) {
        for (int half = 0; half < kBlock; half += kLanes) {
            vf square[kLanes];
#pragma GCC unroll 16
            for (int l = 0; l < kLanes; ++l) square[l] = load(values + block.anchors[half + l] * width + column);
            transpose(square);
#pragma GCC unroll 16
            for (int c = 0; c < kLanes; ++c) store(rows + (column + c) * kBlock + half, square[c]);
        }
    }
    for (; column < width; ++column)
        for (int l = 0; l < kBlock; ++l) rows[column * kBlock + l] = values[block.anchors[l] * width + column];
}

// The inverse, for `count` anchors.
void write_rows(const float* rows, int width, const Block& block, float* values) {
    int column = 0;
    for (; column + kLanes <= width; column += kLanes) {
        for (int half = 0; half < block.count; half += kLanes) {
            vf square[kLanes];
#pragma GCC unroll 16
            for (int c = 0; c < kLanes; ++c) square[c] = load(rows + (column + c) * kBlock + half);
            transpose(square);
            for (int l = 0; l < std::min(kLanes, block.count - half); ++l)
                store(values + block.anchors[half + l] * width + column, square[l]);
        }
    }
    for (; column < width; ++column)
        for (int l = 0; l < block.count; ++l) values[block.anchors[l] * width + column] = rows[column * kBlock + l];
}

// Rows of kBlock floats in one allocation, in the order of requests.
class Rows {
  public:
    int take(int rows) {
        const int first = count_;
        count_ += rows;
        return first;
    }
    size_t size() const { return static_cast<size_t>(count_) * kBlock; }  // floats

  private:
    int count_ = 0;
};

inline float* row_of(float* memory, int row) { return memory + static_cast<size_t>(row) * kBlock; }
inline const float* row_of(const float* memory, int row) { return memory + static_cast<size_t>(row) * kBlock; }
inline int32_t* bit_row_of(float* memory, int row) { return reinterpret_cast<int32_t*>(row_of(memory, row)); }

// The MLPs' inputs of a block: rows 0 ... D - 1 the feature, then the direction, then the distance if it is an input.
struct Inputs {
    float* rows;      // [inputs_padded][kBlock]
    float* distance;  // [kBlock]
    static int take(Rows& rows, const Sizes& s) { return rows.take(s.inputs_padded + 1); }
    Inputs(float* first, const Sizes& s) : rows(first), distance(row_of(first, s.inputs_padded)) {}
    [[gnu::noinline]] void read(const sgs_anchors& a, const Sizes& s, const Block& block) const {
        read_rows(a.features, s.d, block, rows);
        float* direction = rows + s.d * kBlock;
        read_rows(a.positions, 3, block, direction);
        for (int l = 0; l < kBlock; ++l) {
            const float x = direction[l] - a.camera_center[0], y = direction[kBlock + l] - a.camera_center[1],
                        z = direction[2 * kBlock + l] - a.camera_center[2];
            distance[l] = std::max(std::sqrt(x * x + y * y + z * z), 1e-12f);
            direction[l] = x / distance[l];
            direction[kBlock + l] = y / distance[l];
            direction[2 * kBlock + l] = z / distance[l];
        }
        if (s.inputs > s.d + 3) std::copy_n(distance, kBlock, direction + 3 * kBlock);
        for (int i = s.inputs; i < s.inputs_padded; ++i) std::fill_n(rows + i * kBlock, kBlock, 0.0f);
    }
};

// The exponential of three numbers of each anchor, as rows.
void read_exponentials(const float* values, const Block& block, float* rows) {
    read_rows(values, 3, block, rows);
    for (int i = 0; i < 3 * kBlock; i += kLanes) store(rows + i, exponential(load(rows + i)));
}

constexpr int kAcross = kLanes == 16 ? 4 : 2;
constexpr int kDown = kLanes / kAcross;

// out[i][j] += sum over the anchors of a chunk of a[i] * b[j], with `out` in tiles of kDown x kAcross (see `in_tiles`).
// Consecutive blocks of a and of b have a distance of `stride` floats.
[[gnu::noinline]] void add_products(
    const float* a, int rows, const float* b, int columns, size_t stride, int blocks, float* out) {
    for (int i = 0; i < rows; i += kDown) {
        for (int j = 0; j < columns; j += kAcross, out += kLanes) {
            vf sums[kLanes];
            for (vf& sum : sums) sum = splat(0.0f);
            for (int n = 0; n < blocks; ++n) {
                const float* p = a + n * stride + i * kBlock;
                const float* q = b + n * stride + j * kBlock;
#pragma GCC unroll 2
                for (int half = 0; half < kBlock; half += kLanes) {
                    vf right[kAcross];
#pragma GCC unroll 4
                    for (int c = 0; c < kAcross; ++c) right[c] = load(q + c * kBlock + half);
#pragma GCC unroll 4
                    for (int r = 0; r < kDown; ++r) {
                        const vf left = load(p + r * kBlock + half);
#pragma GCC unroll 4
                        for (int c = 0; c < kAcross; ++c) sums[r * kAcross + c] += left * right[c];
                    }
                }
            }
            store(out, load(out) + sums_of_lanes(sums));
        }
    }
}

// Position of element (i, j) in the output of `add_products`.
inline int in_tiles(int i, int j, int columns) {
    return ((i / kDown) * (columns / kAcross) + j / kAcross) * kLanes + (i % kDown) * kAcross + j % kAcross;
}

// out[i] += sum over the anchors of a chunk of a[i].
void add_sums(const float* a, int rows, size_t stride, int blocks, float* out) {
    for (int i = 0; i < rows; ++i) {
        vf sum = splat(0.0f);
        for (int n = 0; n < blocks; ++n) {
            const float* p = a + n * stride + i * kBlock;
            sum += load(p) + load(p + kLanes);
        }
        float lanes[kLanes];
        store(lanes, sum);
        for (int step = kLanes / 2; step > 0; step /= 2)
            for (int l = 0; l < step; ++l) lanes[l] += lanes[l + step];
        out[i] += lanes[0];
    }
}

int32_t* bits_of(const sgs_selection& selection, const Sizes& s, int row, int head) {
    return selection.relu_bits + (static_cast<size_t>(row) * kHeads + head) * s.words;
}

Block active_block(const sgs_anchors& a, const sgs_selection& selection, int begin, int count) {
    Block block{count, {}};
    for (int l = 0; l < kBlock; ++l) block.anchors[l] = a.visible[selection.active[begin + std::min(l, count - 1)]];
    return block;
}

}  // namespace

void anchors_select(const sgs_anchors& a, sgs_selection& out, int threads) {
    const Sizes s(a);
    const Packed first = first_layer(a.heads[0], s), second = second_layer(a.heads[0], s, 0);
    const int m = a.visible_count, chunks = (m + kChunk - 1) / kChunk;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) if (threads > 1)
    for (int chunk = 0; chunk < chunks; ++chunk) {
        Rows rows;
        const int inputs_at = Inputs::take(rows, s), hidden_at = rows.take(s.hidden_padded),
                  raw_at = rows.take(s.outputs_padded[0]), bits_at = rows.take(s.words);
        const Buffer memory(rows.size());
        const Inputs x(row_of(memory.get(), inputs_at), s);
        float* hidden = row_of(memory.get(), hidden_at);
        float* raw = row_of(memory.get(), raw_at);
        int32_t* bits = bit_row_of(memory.get(), bits_at);
        for (int row = chunk * kChunk; row < std::min(m, (chunk + 1) * kChunk); row += kBlock) {
            const int count = std::min(kBlock, m - row);
            Block block{count, {}};
            for (int l = 0; l < kBlock; ++l) block.anchors[l] = a.visible[row + std::min(l, count - 1)];
            x.read(a, s, block);
            first.apply(x.rows, hidden);
            rectify(hidden, s.hidden_padded, bits, s.words);
            second.apply(hidden, raw);
            for (int i = 0; i < s.k * kBlock; i += kLanes) store(raw + i, hyperbolic_tangent(load(raw + i)));
            for (int l = 0; l < count; ++l) {
                float* opacities = out.raw_opacities + static_cast<size_t>(row + l) * s.k;
                for (int j = 0; j < s.k; ++j) opacities[j] = raw[j * kBlock + l];
                for (int w = 0; w < s.words; ++w) bits_of(out, s, row + l, 0)[w] = bits[w * kBlock + l];
            }
        }
    }
    int64_t active = 0, gaussians = 0;
    for (int row = 0; row < m; ++row) {
        int drawn = 0;
        for (int j = 0; j < s.k; ++j) drawn += out.raw_opacities[static_cast<size_t>(row) * s.k + j] > 0.0f;
        if (drawn == 0) continue;
        out.active[active] = row;
        out.starts[active++] = gaussians;
        gaussians += drawn;
    }
    out.starts[active] = gaussians;
    out.active_count = active;
    out.gaussian_count = gaussians;
}

namespace {

// Buffers of a block's attributes.
struct AttributeRows {
    Rows rows;
    int inputs, hidden, color, covariance, norms, reach, base, bits;
    explicit AttributeRows(const Sizes& s)
        : inputs(Inputs::take(rows, s)), hidden(rows.take(s.hidden_padded)), color(rows.take(s.outputs_padded[1])),
          covariance(rows.take(s.outputs_padded[2])), norms(rows.take(s.k)), reach(rows.take(3)), base(rows.take(3)),
          bits(rows.take(s.words)) {}
};

// From head outputs to attributes: sigmoid colours, scales times the base scale, unit quaternions.
void activate(const AttributeRows& at, int k, float* memory) {
    float* color = row_of(memory, at.color);
    const float* base = row_of(memory, at.base);
    for (int i = 0; i < 3 * k * kBlock; i += kLanes) store(color + i, sigmoid(load(color + i)));
    for (int j = 0; j < k; ++j) {
        float* rows = row_of(memory, at.covariance + 7 * j);
        for (int i = 0; i < 3 * kBlock; i += kLanes) store(rows + i, sigmoid(load(rows + i)) * load(base + i));
        float* quat = rows + 3 * kBlock;
        float* norm = row_of(memory, at.norms + j);
        for (int l = 0; l < kBlock; ++l) {
            const float w = quat[l], x = quat[kBlock + l], y = quat[2 * kBlock + l], z = quat[3 * kBlock + l];
            norm[l] = 1.0f / std::max(std::sqrt(w * w + x * x + y * y + z * z), 1e-12f);
            for (int c = 0; c < 4; ++c) quat[c * kBlock + l] *= norm[l];
        }
    }
}

// Writes the drawn Gaussians of a block, from active row `begin` on, to their output rows.
void write_gaussians(
    const sgs_anchors& a, const sgs_selection& selection, const AttributeRows& at, const float* memory, int begin,
    const Block& block, const sgs_gaussians& out) {
    const int k = a.offsets_per_anchor;
    const float* reach = row_of(memory, at.reach);
    for (int l = 0; l < block.count; ++l) {
        const int64_t anchor = block.anchors[l];
        const float* raw = selection.raw_opacities + static_cast<size_t>(selection.active[begin + l]) * k;
        const float* position = a.positions + anchor * 3;
        const int64_t start = selection.starts[begin + l], end = selection.starts[begin + l + 1];
        for (int64_t j = 0, g = start; g < end; ++j) {  // undrawn ones are overwritten by the next
            out.ids[g] = anchor * k + j;
            g += raw[j] > 0.0f;
        }
        for (int64_t g = start; g < end; ++g) {
            const int j = static_cast<int>(out.ids[g] - anchor * k);
            const float* offset = a.offsets + out.ids[g] * 3;
            const float* shape = row_of(memory, at.covariance + 7 * j) + l;
            const float* shade = row_of(memory, at.color + 3 * j) + l;
            for (int c = 0; c < 3; ++c) {
                out.means[3 * g + c] = position[c] + offset[c] * reach[c * kBlock + l];
                out.scales[3 * g + c] = shape[c * kBlock];
                out.colors[3 * g + c] = shade[c * kBlock];
            }
            for (int c = 0; c < 4; ++c) out.quats[4 * g + c] = shape[(3 + c) * kBlock];
            out.quat_norms[g] = row_of(memory, at.norms + j)[l];
            out.opacities[g] = raw[j];
        }
    }
}

}  // namespace

void anchors_dress(const sgs_anchors& a, const sgs_selection& selection, const sgs_gaussians& out, int threads) {
    const Sizes s(a);
    const AttributeRows at(s);
    const Packed first[2] = {first_layer(a.heads[1], s), first_layer(a.heads[2], s)};
    const Packed second[2] = {second_layer(a.heads[1], s, 1), second_layer(a.heads[2], s, 2)};
    const int total = static_cast<int>(selection.active_count), chunks = (total + kChunk - 1) / kChunk;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) if (threads > 1)
    for (int chunk = 0; chunk < chunks; ++chunk) {
        const Buffer buffer(at.rows.size());
        float* memory = buffer.get();
        const Inputs x(row_of(memory, at.inputs), s);
        float* hidden = row_of(memory, at.hidden);
        int32_t* bits = bit_row_of(memory, at.bits);
        for (int begin = chunk * kChunk; begin < std::min(total, (chunk + 1) * kChunk); begin += kBlock) {
            const int count = std::min(kBlock, total - begin);
            const Block block = active_block(a, selection, begin, count);
            x.read(a, s, block);
            for (int h = 1; h < kHeads; ++h) {
                first[h - 1].apply(x.rows, hidden);
                rectify(hidden, s.hidden_padded, bits, s.words);
                for (int l = 0; l < count; ++l)
                    for (int w = 0; w < s.words; ++w)
                        bits_of(selection, s, selection.active[begin + l], h)[w] = bits[w * kBlock + l];
                second[h - 1].apply(hidden, row_of(memory, h == 1 ? at.color : at.covariance));
            }
            read_exponentials(a.log_offset_scales, block, row_of(memory, at.reach));
            read_exponentials(a.log_base_scales, block, row_of(memory, at.base));
            activate(at, s.k, memory);
            write_gaussians(a, selection, at, memory, begin, block, out);
        }
    }
}

namespace {

// Buffers of a block in the backward pass. Those of all blocks of a chunk are retained for the sums over the chunk.
struct GradientRows {
    Rows rows;
    int inputs, outputs[kHeads], hidden_gradients[kHeads], hidden[kHeads];
    explicit GradientRows(const Sizes& s) : inputs(Inputs::take(rows, s)) {
        for (int h = 0; h < kHeads; ++h) outputs[h] = rows.take(s.outputs_padded[h]);
        for (int& row : hidden_gradients) row = rows.take(s.hidden_padded);  // contiguous, for a single product
        for (int& row : hidden) row = rows.take(s.hidden_padded);
    }
};

// Scratch memory of one block.
struct ScratchRows {
    Rows rows;
    int input_gradient, means, bits;
    explicit ScratchRows(const Sizes& s)
        : input_gradient(rows.take(s.inputs_padded)), means(rows.take(3)), bits(rows.take(s.words)) {}
};

// Positions of the weight gradients in a group's sums: the trained heads one after the other, w1 and w2 in the tiles of
// `add_products`.
struct SumPlaces {
    size_t w1[kHeads], b1[kHeads], w2[kHeads], b2[kHeads], size = 0;
    SumPlaces(const Sizes& s, const bool (&trained)[kHeads]) {
        for (int h = 0; h < kHeads; ++h) {
            w1[h] = size;
            b1[h] = w1[h] + static_cast<size_t>(s.hidden_padded) * s.inputs_padded;
            w2[h] = b1[h] + s.hidden_padded;
            b2[h] = w2[h] + static_cast<size_t>(s.outputs_padded[h]) * s.hidden_padded;
            if (trained[h]) size = b2[h] + s.outputs_padded[h];
        }
    }
};

// Inputs of the backward pass.
struct Backward {
    const sgs_anchors& a;
    const sgs_selection& selection;
    const sgs_gaussians& drawn;
    const sgs_gaussian_gradients& from;
    const sgs_anchor_gradients& to;
    Sizes s;
    bool trained[kHeads];
    bool to_inputs;    // the MLPs' inputs need a gradient
    int input_first;   // its first row
    GradientRows at;
    ScratchRows scratch;
    SumPlaces sums;
    Packed first[kHeads], to_hidden[kHeads], to_input;

    Backward(
        const sgs_anchors& anchors, const sgs_selection& selected, const sgs_gaussians& gaussians,
        const sgs_gaussian_gradients& given, const sgs_anchor_gradients& wanted)
        : a(anchors), selection(selected), drawn(gaussians), from(given), to(wanted), s(anchors),
          trained{to.heads[0].w1 != nullptr, to.heads[1].w1 != nullptr, to.heads[2].w1 != nullptr},
          to_inputs(to.positions != nullptr || to.features != nullptr), input_first(to.features != nullptr ? 0 : s.d),
          at(s), scratch(s), sums(s, trained),
          first{first_layer(a.heads[0], s), first_layer(a.heads[1], s), first_layer(a.heads[2], s)},
          to_hidden{
              second_layer_backwards(a.heads[0], s, 0), second_layer_backwards(a.heads[1], s, 1),
              second_layer_backwards(a.heads[2], s, 2)},
          to_input(s.inputs - input_first, kHeads * s.hidden_padded, nullptr, [this](int o, int i) {
              const int h = i / s.hidden_padded, unit = i % s.hidden_padded;
              return unit < s.hidden ? a.heads[h].w1[unit * s.inputs + input_first + o] : 0.0f;
          }) {}
    bool uses(int h) const { return trained[h] || to_inputs; }
    // One more than the anchor of an active row, 0 before the first.
    int64_t end_of(int64_t row) const { return row < 0 ? 0 : a.visible[selection.active[row]] + 1; }
};

// Sets the gradients of the anchors first ... end - 1 to zero.
void clear_rows(const Backward& b, int64_t first, int64_t end) {
    const auto clear = [=](float* rows, int width) {
        if (rows != nullptr) std::memset(rows + first * width, 0, sizeof(float) * width * (end - first));
    };
    if (first == end) return;
    clear(b.to.positions, 3);
    clear(b.to.log_offset_scales, 3);
    clear(b.to.log_base_scales, 3);
    clear(b.to.offsets, 3 * b.s.k);
    clear(b.to.features, b.s.d);
}

// From gradients of a block's Gaussians to gradients of the heads' outputs (before activation) and of the anchors.
[[gnu::noinline]] void gather(
    const Backward& b, int begin, const Block& block, float* const (&outputs)[kHeads], float* to_means) {
    const int k = b.s.k;
    float reach[3 * kBlock], base[3 * kBlock], to_reach[3 * kBlock], to_base[3 * kBlock];
    read_exponentials(b.a.log_offset_scales, block, reach);
    read_exponentials(b.a.log_base_scales, block, base);
    for (int h = 0; h < kHeads; ++h)
        if (b.uses(h)) std::memset(outputs[h], 0, sizeof(float) * b.s.outputs_padded[h] * kBlock);
    for (int l = 0; l < block.count; ++l) {
        const int64_t first_id = block.anchors[l] * k;
        float mean_sum[3] = {}, reach_sum[3] = {}, base_sum[3] = {};
        if (b.to.offsets != nullptr) std::memset(b.to.offsets + first_id * 3, 0, sizeof(float) * 3 * k);
        for (int64_t g = b.selection.starts[begin + l]; g < b.selection.starts[begin + l + 1]; ++g) {
            const int j = static_cast<int>(b.drawn.ids[g] - first_id);
            const float* offset = b.a.offsets + b.drawn.ids[g] * 3;
            float scale_gradient[3];
            for (int c = 0; c < 3; ++c) {
                const float gradient = b.from.means[3 * g + c];
                mean_sum[c] += gradient;
                reach_sum[c] += gradient * offset[c];
                scale_gradient[c] = b.from.scales[3 * g + c] * b.drawn.scales[3 * g + c];
                base_sum[c] += scale_gradient[c];
            }
            if (b.to.offsets != nullptr)
                for (int c = 0; c < 3; ++c)
                    b.to.offsets[b.drawn.ids[g] * 3 + c] = b.from.means[3 * g + c] * reach[c * kBlock + l];
            if (b.uses(0)) {
                const float value = b.drawn.opacities[g];
                outputs[0][j * kBlock + l] = b.from.opacities[g] * (1.0f - value * value);
            }
            if (b.uses(1)) {
                float* out = outputs[1] + 3 * j * kBlock + l;
                for (int c = 0; c < 3; ++c) {
                    const float value = b.drawn.colors[3 * g + c];
                    out[c * kBlock] = b.from.colors[3 * g + c] * value * (1.0f - value);
                }
            }
            if (b.uses(2)) {
                float* out = outputs[2] + 7 * j * kBlock + l;
                for (int c = 0; c < 3; ++c)
                    out[c * kBlock] = scale_gradient[c] * (1.0f - b.drawn.scales[3 * g + c] / base[c * kBlock + l]);
                const float* gradient = b.from.quats + 4 * g;
                const float* quat = b.drawn.quats + 4 * g;
                const float along =
                    gradient[0] * quat[0] + gradient[1] * quat[1] + gradient[2] * quat[2] + gradient[3] * quat[3];
                for (int c = 0; c < 4; ++c)
                    out[(3 + c) * kBlock] = (gradient[c] - along * quat[c]) * b.drawn.quat_norms[g];
            }
        }
        for (int c = 0; c < 3; ++c) {
            to_means[c * kBlock + l] = mean_sum[c];
            to_reach[c * kBlock + l] = reach_sum[c] * reach[c * kBlock + l];
            to_base[c * kBlock + l] = base_sum[c];
        }
    }
    if (b.to.log_offset_scales != nullptr) write_rows(to_reach, 3, block, b.to.log_offset_scales);
    if (b.to.log_base_scales != nullptr) write_rows(to_base, 3, block, b.to.log_base_scales);
}

// From gradients of the MLPs' inputs and of the means to gradients of features and positions.
[[gnu::noinline]] void give(
    const Backward& b, const Inputs& x, const float* inputs, const float* to_means, const Block& block) {
    const int d = b.s.d;
    if (b.to.features != nullptr) write_rows(inputs, d, block, b.to.features);
    if (b.to.positions == nullptr) return;
    const float* gradient = inputs + (d - b.input_first) * kBlock;
    const float* direction = x.rows + d * kBlock;
    const bool distance_input = b.s.inputs > d + 3;
    float to_positions[3 * kBlock];
    for (int l = 0; l < kBlock; ++l) {
        float along = 0.0f;
        for (int c = 0; c < 3; ++c) along += gradient[c * kBlock + l] * direction[c * kBlock + l];
        const float to_distance = distance_input ? gradient[3 * kBlock + l] : 0.0f;
        for (int c = 0; c < 3; ++c)
            to_positions[c * kBlock + l] =
                to_means[c * kBlock + l] +
                (gradient[c * kBlock + l] - along * direction[c * kBlock + l]) / x.distance[l] +
                to_distance * direction[c * kBlock + l];
    }
    write_rows(to_positions, 3, block, b.to.positions);
}

// The rows of one block, and the gradients of its anchors.
void block_backward(const Backward& b, int begin, int count, float* rows, float* scratch) {
    const Sizes& s = b.s;
    const Inputs x(row_of(rows, b.at.inputs), s);
    float* input_gradient = row_of(scratch, b.scratch.input_gradient);
    float* means = row_of(scratch, b.scratch.means);
    int32_t* bits = bit_row_of(scratch, b.scratch.bits);
    float* const outputs[kHeads] = {
        row_of(rows, b.at.outputs[0]), row_of(rows, b.at.outputs[1]), row_of(rows, b.at.outputs[2])};
    const Block block = active_block(b.a, b.selection, begin, count);
    x.read(b.a, s, block);
    for (int l = 0; l < count; ++l) clear_rows(b, b.end_of(begin + l - 1), block.anchors[l]);
    gather(b, begin, block, outputs, means);
    for (int h = 0; h < kHeads; ++h) {
        if (!b.uses(h)) continue;
        float* gradient = row_of(rows, b.at.hidden_gradients[h]);
        b.to_hidden[h].apply(outputs[h], gradient);
        for (int l = 0; l < kBlock; ++l) {
            const int row = b.selection.active[begin + std::min(l, count - 1)];
            const int32_t* kept = bits_of(b.selection, s, row, h);
            for (int w = 0; w < s.words; ++w) bits[w * kBlock + l] = kept[w];
        }
        mask(gradient, s.hidden_padded, bits);
        if (b.trained[h]) {
            float* values = row_of(rows, b.at.hidden[h]);
            b.first[h].apply(x.rows, values);
            mask(values, s.hidden_padded, bits);
        }
    }
    if (b.to_inputs) {
        b.to_input.apply(row_of(rows, b.at.hidden_gradients[0]), input_gradient);
        give(b, x, input_gradient, means, block);
    }
}

// Adds the weight gradients of a chunk's blocks to a group's sums.
void add_weights(const Backward& b, const float* rows, int blocks, float* sums) {
    const Sizes& s = b.s;
    const size_t stride = b.at.rows.size();
    const float* inputs = row_of(rows, b.at.inputs);
    for (int h = 0; h < kHeads; ++h) {
        if (!b.trained[h]) continue;
        const float* gradient = row_of(rows, b.at.hidden_gradients[h]);
        const float* hidden = row_of(rows, b.at.hidden[h]);
        const float* outputs = row_of(rows, b.at.outputs[h]);
        add_products(gradient, s.hidden_padded, inputs, s.inputs_padded, stride, blocks, sums + b.sums.w1[h]);
        add_sums(gradient, s.hidden_padded, stride, blocks, sums + b.sums.b1[h]);
        add_products(outputs, s.outputs_padded[h], hidden, s.hidden_padded, stride, blocks, sums + b.sums.w2[h]);
        add_sums(outputs, s.outputs_padded[h], stride, blocks, sums + b.sums.b2[h]);
    }
}

// Sums over all groups, without tiles and padding.
void write_weights(const Backward& b, const float* sums) {
    const Sizes& s = b.s;
    for (int h = 0; h < kHeads; ++h) {
        if (!b.trained[h]) continue;
        const float *w1 = sums + b.sums.w1[h], *w2 = sums + b.sums.w2[h];
        const sgs_head_gradient& out = b.to.heads[h];
        for (int o = 0; o < s.hidden; ++o)
            for (int i = 0; i < s.inputs; ++i) out.w1[o * s.inputs + i] = w1[in_tiles(o, i, s.inputs_padded)];
        for (int o = 0; o < s.outputs[h]; ++o)
            for (int i = 0; i < s.hidden; ++i) out.w2[o * s.hidden + i] = w2[in_tiles(o, i, s.hidden_padded)];
        std::copy_n(sums + b.sums.b1[h], s.hidden, out.b1);
        std::copy_n(sums + b.sums.b2[h], s.outputs[h], out.b2);
    }
}

}  // namespace

void anchors_backward(
    const sgs_anchors& a, const sgs_selection& selection, const sgs_gaussians& drawn,
    const sgs_gaussian_gradients& from, const sgs_anchor_gradients& to, int threads) {
    const Backward b(a, selection, drawn, from, to);
    const int total = static_cast<int>(selection.active_count), chunks = (total + kChunk - 1) / kChunk;
    const int groups = std::min(chunks, kGroups);
    const size_t size = b.sums.size;
    const Buffer memory_of_sums(std::max(1, groups) * size);
    float* sums = memory_of_sums.get();
    std::memset(sums, 0, sizeof(float) * std::max(1, groups) * size);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) if (threads > 1)
    for (int group = 0; group < groups; ++group) {
        const Buffer memory(kChunkBlocks * b.at.rows.size() + b.scratch.rows.size());
        float* scratch = memory.get() + kChunkBlocks * b.at.rows.size();
        for (int chunk = static_cast<int>(static_cast<int64_t>(chunks) * group / groups);
             chunk < static_cast<int>(static_cast<int64_t>(chunks) * (group + 1) / groups); ++chunk) {
            const int end = std::min(total, (chunk + 1) * kChunk);
            const int blocks = (end - chunk * kChunk + kBlock - 1) / kBlock;
            for (int n = 0; n < blocks; ++n) {
                const int begin = chunk * kChunk + n * kBlock;
                block_backward(b, begin, std::min(kBlock, end - begin), memory.get() + n * b.at.rows.size(), scratch);
            }
            add_weights(b, memory.get(), blocks, sums + group * size);
        }
    }
    clear_rows(b, b.end_of(total - 1), to.anchors);
    for (int group = 1; group < groups; ++group)
        for (size_t i = 0; i < size; ++i) sums[i] += sums[group * size + i];
    write_weights(b, sums);
}

}  // namespace SGS_ISA
}  // namespace structgstream
