// SPDX-License-Identifier: Apache-2.0
// Adaptive binary decisions (docs/entropy.md, Decisions) and the contexts of rows (docs/bitstream.md, Rows). Input may be
// hostile: the number of decisions is bounded by the request, bytes after the end count as zeros, and every index from
// the input is checked.

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <new>
#include <vector>

#include "structgstream.h"

namespace {

enum Result { kDone = 0, kNoMemory = 1, kDamaged = 2, kRefused = 3 };

constexpr int kResidualInputs = 6;
constexpr int kLeast = 32, kMost = 65536 - 32;  // bounds of a probability
constexpr int kFar = 1983;                      // bound of its logit
constexpr int kWeightLimit = (1 << 19) - 1;
constexpr int kNearSizes = 6;    // sizes with a decision of their own
constexpr int kLengthNodes = 9;  // bit lengths of larger sizes with a decision of their own
constexpr int kLengths = 30;
constexpr int kNodes = 2 + kNearSizes + kLengthNodes;
constexpr int64_t kLargestNumber = (int64_t{1} << 31) - 1;
constexpr int32_t kLargestResidual = 1 << 23;
constexpr int kBlock = 32;

// 65536 / (1 + exp(-j / 4)), rounded.
constexpr int kSquashed[32] = {32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834, 57724, 59287, 60565,
                               61598, 62428, 63090, 63615, 64030, 64357, 64614, 64816, 64974, 65097, 65194,
                               65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508};

int squash(int logit) {
    const int size = std::min(std::abs(logit), kFar);
    const int place = size >> 6;
    const int chance = kSquashed[place] + ((kSquashed[place + 1] - kSquashed[place]) * (size & 63) >> 6);
    return std::clamp(logit < 0 ? 65536 - chance : chance, kLeast, kMost);
}

struct Constants {
    int16_t stretch[4096];
    uint16_t squash_of[2 * kFar + 1];
    int32_t share[256];
    Constants() {
        for (int logit = -kFar; logit <= kFar; ++logit) squash_of[logit + kFar] = static_cast<uint16_t>(squash(logit));
        for (int i = 0, logit = -kFar; i < 4096; ++i) {
            while (logit < kFar && squash(logit) < 16 * i + 8) ++logit;
            stretch[i] = static_cast<int16_t>(logit);
        }
        for (int seen = 0; seen < 256; ++seen) share[seen] = 65536 / (seen + 2);
    }
};

const Constants& constants() {
    static const Constants made;
    return made;
}

// The bytes of a field during writing or reading.
template <bool kEncodes>
struct Arithmetic {
    explicit Arithmetic(sgs_arithmetic* outer) : outer(outer), low(outer->low), range(outer->range), place(outer->place) {
        if (!outer->started) {
            range = 0xffffffffu;
            low = 0;
            if (!kEncodes)
                for (int i = 0; i < 4; ++i) low = low << 8 | next();
            outer->started = 1;
        }
    }

    ~Arithmetic() {
        outer->low = low;
        outer->range = range;
        outer->place = place;
    }

    uint32_t next() {
        const uint32_t byte = place < outer->size ? outer->bytes[place] : 0;
        ++place;
        return byte;
    }

    // In an encoder `low` is the start of the range, in a decoder the offset of the code value from it.
    bool decide(bool yes, int chance) {
        const uint32_t bound = (range >> 16) * static_cast<uint32_t>(chance);
        if (!kEncodes) yes = low < bound;
        if (yes) {
            range = bound;
        } else {
            if (kEncodes) {
                if (low + bound < low)
                    for (int64_t at = place - 1; at >= 0 && ++outer->bytes[at] == 0; --at) {}
                low += bound;
            } else {
                low -= bound;
            }
            range -= bound;
        }
        while (range < 1u << 24) {
            if (kEncodes) {
                outer->bytes[place++] = static_cast<uint8_t>(low >> 24);
                low <<= 8;
            } else {
                low = low << 8 | next();
            }
            range <<= 8;
        }
        return yes;
    }

    sgs_arithmetic* outer;
    uint32_t low, range;
    int64_t place;
};

// The decisions of one model with a given number of inputs. `at` looks up a number's contexts once.
template <bool kEncodes, int kInputs>
struct Coder {
    Coder(sgs_arithmetic* arithmetic, const sgs_model* model)
        : arithmetic(arithmetic), model(*model), table(constants()) {}

    void at(const int32_t* contexts) {
        for (int k = 0; k < kInputs; ++k) rows[k] = (model.starts[k] + contexts[k]) * model.nodes;
    }

    bool decide(bool yes, int node) {
        int32_t* weights = model.weights + node * kInputs;
        uint16_t* chances = model.chances + node;
        uint8_t* seen = model.seen + node;
        int32_t logits[kInputs];
        int32_t sum = 0;
        for (int k = 0; k < kInputs; ++k) {
            logits[k] = table.stretch[chances[rows[k]] >> 4];
            sum += weights[k] * logits[k] >> 16;
        }
        const int chance = table.squash_of[std::clamp(sum, -kFar, kFar) + kFar];
        yes = arithmetic.decide(yes, chance);
        const int32_t target = yes ? 65536 : 0, error = (target - chance) >> 4;
        for (int k = 0; k < kInputs; ++k)
            weights[k] = std::clamp(weights[k] + ((logits[k] * error + 4096) >> 13), -kWeightLimit, kWeightLimit);
        for (int k = 0; k < kInputs; ++k) {
            const int32_t cell = chances[rows[k]], count = seen[rows[k]];
            chances[rows[k]] =
                static_cast<uint16_t>(std::clamp(cell + ((target - cell) * table.share[count] >> 16), kLeast, kMost));
            seen[rows[k]] = static_cast<uint8_t>(count + (count < 255));
        }
        return yes;
    }

    // A signed number; false if it is damaged.
    bool number(int64_t* value) {
        const int64_t given = kEncodes ? *value : 0;
        if (!decide(given != 0, 0)) {
            *value = 0;
            return true;
        }
        const bool negative = decide(given < 0, 1);
        const int64_t given_size = given < 0 ? -given : given;
        int64_t size = 1;
        while (size <= kNearSizes && decide(given_size > size, 1 + static_cast<int>(size))) ++size;
        if (size > kNearSizes) {
            const int64_t given_rest = given_size - kNearSizes;
            int length = 0;
            while (length < kLengths &&
                   decide(given_rest >> length > 1, 2 + kNearSizes + std::min(length, kLengthNodes - 1)))
                ++length;
            int64_t rest = 1;
            for (int bit = length - 1; bit >= 0; --bit) rest = rest << 1 | arithmetic.decide(given_rest >> bit & 1, 32768);
            size = rest + kNearSizes;
        }
        *value = negative ? -size : size;
        return size <= kLargestNumber;
    }

    Arithmetic<kEncodes> arithmetic;
    sgs_model model;
    int32_t rows[kInputs];
    const Constants& table;
};

int bit_length(int64_t value, int most) {
    int length = 0;
    while (length < most && value >> length) ++length;
    return length;
}

// Size classes 0 to 15: one per size below 8, then two per octave.
int size_class(int32_t size) {
    if (size < 8) return size;
    const int top = 31 - __builtin_clz(static_cast<uint32_t>(size));
    return std::min(2 * top + (size >> (top - 1) & 1) + 2, 15);
}

int32_t limited(int32_t value, int32_t most) { return std::clamp(value, -most, most); }

// The first row of a pass and the distance of its rows; neighbours are at distance `first`; pass 0 has none.
struct Pass {
    int64_t first, step;
};

constexpr Pass kPasses[5] = {{0, 16}, {8, 16}, {4, 8}, {2, 4}, {1, 2}};

template <bool kEncodes>
Result code_activity(sgs_arithmetic* arithmetic, const sgs_model* block_model, const sgs_model* row_model, int64_t count,
                     const uint8_t* history, const int32_t* sizes, uint8_t* active) {
    const size_t rows = static_cast<size_t>(count), block_count = (rows + kBlock - 1) / kBlock;
    const int64_t blocks = static_cast<int64_t>(block_count);
    // Rows that do not exist count as inactive, now and before.
    std::vector<uint8_t> now(rows + 64, 0), there(block_count, 0);
    std::vector<int32_t> moved(rows + 4, 0);
    std::vector<int32_t> before(rows + 1, 0);  // number of active rows before each row
    std::vector<uint8_t> last(block_count + 2, 0), ever(block_count, 0);
    uint8_t* found = now.data() + 32;
    uint8_t* has = there.data();
    for (int64_t i = 0; i < count; ++i) {
        moved[i + 2] = sizes[i];
        before[i + 1] = before[i] + (history[i] & 1);
        last[i / kBlock + 1] += history[i] & 1;
        ever[i / kBlock] += history[i] != 0;
    }
    if (kEncodes)
        for (int64_t i = 0; i < count; ++i) has[i / kBlock] |= active[i];
    for (auto& number : last) number = static_cast<uint8_t>(bit_length(number, 5));
    {
        Coder<kEncodes, 2> coder(arithmetic, block_model);
        for (int level = 0; level < 5; ++level) {
            const Pass pass = kPasses[level];
            for (int64_t b = pass.first; b < blocks; b += pass.step) {
                // Neighbours that a decoder has not decoded yet are not used as context.
                const int adjacent = level ? has[b - pass.first] + (b + pass.first < blocks ? has[b + pass.first] : 0) : 0;
                const int32_t contexts[2] = {(last[b + 1] * 3 + adjacent) * 5 + level,
                                             (bit_length(ever[b], 5) * 11 + last[b] + last[b + 2]) * 3 + adjacent};
                coder.at(contexts);
                has[b] = coder.decide(has[b], 0);
            }
        }
    }
    Coder<kEncodes, 3> coder(arithmetic, row_model);
    for (int level = 0; level < 5; ++level) {
        const Pass pass = kPasses[level];
        const int64_t near = pass.first, far = 3 * pass.first;
        for (int64_t i = pass.first; i < count; i += pass.step) {
            if (!has[i / kBlock]) continue;
            const int adjacent = level ? found[i - near] + found[i + near] : 0;
            const int farther = level ? found[i - far] + found[i + far] : 0;
            const int wide = before[std::min(i + 9, count)] - before[std::max<int64_t>(i - 8, 0)] - (history[i] & 1);
            const int32_t around = moved[i] + moved[i + 1] + moved[i + 3] + moved[i + 4];
            const int32_t contexts[3] = {(wide * 3 + adjacent) * 5 + level,
                                         (bit_length(sizes[i], 5) * 3 + adjacent) * 6 + bit_length(around, 5),
                                         ((level * 3 + farther) * 3 + adjacent) * 8 + (history[i] & 7)};
            coder.at(contexts);
            found[i] = coder.decide(active[i], 0);
        }
    }
    if (!kEncodes) std::copy_n(found, count, active);
    return kDone;
}

template <bool kEncodes>
Result code_residuals(sgs_arithmetic* arithmetic, const sgs_model* model, int64_t count, int columns, const int32_t* last,
                      const int32_t* others, int32_t* residuals) {
    Coder<kEncodes, kResidualInputs> coder(arithmetic, model);
    std::vector<int32_t> earlier(static_cast<size_t>(count), 0);  // sizes in earlier columns
    std::vector<uint8_t> moved(static_cast<size_t>(count), 0);
    for (int64_t a = 0; a < count; ++a)
        for (int column = 0; column < columns; ++column) moved[a] |= last[a * columns + column] != 0;
    for (int column = 0; column < columns; ++column) {
        for (int level = 0; level < 5; ++level) {
            const Pass pass = kPasses[level];
            for (int64_t a = pass.first; a < count; a += pass.step) {
                const int64_t at = a * columns + column;
                const int32_t own = last[at];
                const int32_t above = level ? residuals[at - pass.first * columns] : 0;
                const int32_t below = level && a + pass.first < count ? residuals[at + pass.first * columns] : 0;
                const int32_t adjacent = std::abs(above) + std::abs(below);
                const int32_t first = column ? residuals[at - 1] : 0;
                const int32_t off = column ? first - last[at - 1] : 0;
                // Sixteenths of a quantization step.
                const int32_t predicted = moved[a] ? (level ? 10 * own + 3 * (above + below) : 16 * own) : 8 * (above + below);
                const int32_t expected = size_class((std::abs(predicted) + 4) >> 3);
                const int32_t contexts[kResidualInputs] = {
                    (limited(own, 8) + 8) * columns + column,
                    (limited(above, 4) + 4) * 9 + limited(below, 4) + 4,
                    ((predicted < 0 ? -expected : expected) + 15) * 5 + level,
                    (std::min(earlier[a], 9) * 6 + std::min(adjacent, 5)) * columns + column,
                    (bit_length(others[a], 5) * columns + column) * 16 + size_class(2 * std::abs(own) + adjacent),
                    ((limited(first, 3) + 3) * 7 + limited(off, 3) + 3) * 7 + limited(own, 3) + 3,
                };
                int64_t value = residuals[at];
                coder.at(contexts);
                if (!coder.number(&value) || value < -kLargestResidual || value > kLargestResidual)
                    return kDamaged;
                residuals[at] = static_cast<int32_t>(value);
            }
        }
        for (int64_t a = 0; a < count; ++a) earlier[a] += std::min(std::abs(residuals[a * columns + column]), 9);
    }
    return kDone;
}

template <bool kEncodes, int kInputs>
Result code_numbers(sgs_arithmetic* arithmetic, const sgs_model* model, int64_t count, const int32_t* contexts, bool flags,
                    int64_t* values) {
    Coder<kEncodes, kInputs> coder(arithmetic, model);
    for (int64_t i = 0; i < count; ++i) {
        coder.at(contexts + i * kInputs);
        if (flags)
            values[i] = coder.decide(values[i] != 0, 0);
        else if (!coder.number(values + i))
            return kDamaged;
    }
    return kDone;
}

bool fits(const sgs_model* model, int inputs, int nodes) {
    return model->inputs == inputs && model->nodes == nodes;
}

}  // namespace

extern "C" int sgs_code_activity(sgs_arithmetic* arithmetic, const sgs_model* blocks, const sgs_model* rows, int encodes,
                                 int64_t count, const uint8_t* history, const int32_t* sizes, uint8_t* active) {
    if (count < 0 || !fits(blocks, 2, 1) || !fits(rows, 3, 1)) return kRefused;
    try {
        return encodes ? code_activity<true>(arithmetic, blocks, rows, count, history, sizes, active)
                       : code_activity<false>(arithmetic, blocks, rows, count, history, sizes, active);
    } catch (const std::bad_alloc&) {
        return kNoMemory;
    }
}

extern "C" int sgs_code_residuals(sgs_arithmetic* arithmetic, const sgs_model* model, int encodes, int64_t count, int columns,
                                  const int32_t* last, const int32_t* others, int32_t* residuals) {
    if (count < 0 || columns < 1 || !fits(model, kResidualInputs, kNodes)) return kRefused;
    try {
        return encodes ? code_residuals<true>(arithmetic, model, count, columns, last, others, residuals)
                       : code_residuals<false>(arithmetic, model, count, columns, last, others, residuals);
    } catch (const std::bad_alloc&) {
        return kNoMemory;
    }
}

extern "C" int sgs_code_numbers(sgs_arithmetic* arithmetic, const sgs_model* model, int encodes, int64_t count,
                                const int32_t* contexts, int flags, int64_t* values) {
    const int nodes = flags ? 1 : kNodes;
    if (count < 0) return kRefused;
    if (fits(model, 1, nodes))
        return encodes ? code_numbers<true, 1>(arithmetic, model, count, contexts, flags != 0, values)
                       : code_numbers<false, 1>(arithmetic, model, count, contexts, flags != 0, values);
    if (fits(model, 3, nodes))
        return encodes ? code_numbers<true, 3>(arithmetic, model, count, contexts, flags != 0, values)
                       : code_numbers<false, 3>(arithmetic, model, count, contexts, flags != 0, values);
    return kRefused;
}
