// SPDX-License-Identifier: Apache-2.0
// Interleaved rANS (docs/entropy.md): 32-bit states, 16-bit words, 12-bit frequencies. Input may be hostile: every index
// is checked before it is used.

#include <cstdint>
#include <cstring>
#include <memory>
#include <new>

#include "structgstream.h"

namespace {

constexpr uint32_t kLow = 1u << 16;
constexpr int kBits = 12;
constexpr uint32_t kTotal = 1u << kBits;
constexpr int kMaxLanes = 32;
constexpr int kMaxAlphabet = 32;
constexpr uint32_t kAbsent = 0xffffffffu;

enum Result { kDone = 0, kNoMemory = 1, kDamaged = 2, kRefused = 3 };

// The rows of the table that occur, contiguous: a frequency in the high half, its cumulative frequency in the low half.
struct Rows {
    std::unique_ptr<uint32_t[]> row_of;  // [context_count], or kAbsent
    std::unique_ptr<uint32_t[]> entries;  // [used, alphabet]
    std::unique_ptr<uint8_t[]> slots;     // [used, kTotal] symbols, for the decoder
    int64_t used = 0;
};

Result prepare(const uint16_t* contexts, int64_t count, const uint16_t* frequencies, int64_t context_count, int alphabet,
               bool decoding, Rows* rows) {
    if (alphabet < 1 || alphabet > kMaxAlphabet || context_count < 1) return kRefused;
    rows->row_of.reset(new (std::nothrow) uint32_t[context_count]);
    if (!rows->row_of) return kNoMemory;
    std::memset(rows->row_of.get(), 0xff, sizeof(uint32_t) * context_count);
    for (int64_t i = 0; i < count; ++i) {
        if (contexts[i] >= context_count) return kRefused;
        uint32_t& row = rows->row_of[contexts[i]];
        if (row == kAbsent) row = static_cast<uint32_t>(rows->used++);
    }
    rows->entries.reset(new (std::nothrow) uint32_t[rows->used * alphabet]);
    if (decoding) rows->slots.reset(new (std::nothrow) uint8_t[rows->used * kTotal]);
    if (!rows->entries || (decoding && !rows->slots)) return kNoMemory;
    for (int64_t context = 0; context < context_count; ++context) {
        const uint32_t row = rows->row_of[context];
        if (row == kAbsent) continue;
        uint32_t below = 0;
        for (int symbol = 0; symbol < alphabet; ++symbol) {
            const uint32_t frequency = frequencies[context * alphabet + symbol];
            if (frequency > kTotal - below) return kRefused;
            rows->entries[static_cast<int64_t>(row) * alphabet + symbol] = frequency << 16 | below;
            if (decoding) std::memset(rows->slots.get() + static_cast<int64_t>(row) * kTotal + below, symbol, frequency);
            below += frequency;
        }
        if (below != kTotal) return kRefused;
    }
    return kDone;
}

// One step of a lane without the renormalisation.
inline uint32_t take(uint32_t state, uint32_t row, const Rows& rows, int alphabet, uint8_t* symbol) {
    const uint32_t slot = state & (kTotal - 1);
    const uint8_t found = rows.slots[static_cast<int64_t>(row) * kTotal + slot];
    const uint32_t entry = rows.entries[static_cast<int64_t>(row) * alphabet + found];
    *symbol = found;
    return (entry >> 16) * (state >> kBits) + slot - (entry & 0xffff);
}

template <int kLanes>
Result decode(const uint16_t* words, int64_t word_count, const uint32_t* initial, const uint16_t* contexts,
              int64_t count, const Rows& rows, int alphabet, uint8_t* symbols) {
    uint32_t states[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
        states[lane] = initial[lane];
        if (states[lane] < kLow) return kDamaged;
    }
    const uint32_t* row_of = rows.row_of.get();
    int64_t i = 0, position = 0;
    // While at least one word per lane is left, no bounds check is needed.
    for (; i + kLanes <= count && word_count - position >= kLanes; i += kLanes) {
        for (int lane = 0; lane < kLanes; ++lane) {
            uint32_t state = take(states[lane], row_of[contexts[i + lane]], rows, alphabet, symbols + i + lane);
            const bool low = state < kLow;
            const uint32_t filled = state << 16 | words[position];
            state = low ? filled : state;
            position += low;
            states[lane] = state;
        }
    }
    for (; i < count; ++i) {
        uint32_t& state = states[i % kLanes];
        state = take(state, row_of[contexts[i]], rows, alphabet, symbols + i);
        if (state < kLow) {
            if (position == word_count) return kDamaged;
            state = state << 16 | words[position++];
        }
    }
    for (int lane = 0; lane < kLanes; ++lane)
        if (states[lane] != kLow) return kDamaged;
    return position == word_count ? kDone : kDamaged;
}

}  // namespace

extern "C" int sgs_rans_encode(const uint8_t* symbols, const uint16_t* contexts, int64_t count,
                               const uint16_t* frequencies, int64_t context_count, int alphabet, int lanes,
                               uint32_t* states, uint16_t* words, int64_t* word_count) {
    if (lanes < 1 || lanes > kMaxLanes || count < 0) return kRefused;
    Rows rows;
    const Result ready = prepare(contexts, count, frequencies, context_count, alphabet, false, &rows);
    if (ready != kDone) return ready;
    for (int lane = 0; lane < lanes; ++lane) states[lane] = kLow;
    int64_t free_words = count;  // Words are written from the end, because the decoder reads forwards.
    for (int64_t i = count - 1; i >= 0; --i) {
        if (symbols[i] >= alphabet) return kRefused;
        const uint32_t entry = rows.entries[static_cast<int64_t>(rows.row_of[contexts[i]]) * alphabet + symbols[i]];
        const uint32_t frequency = entry >> 16;
        if (frequency == 0) return kRefused;
        uint32_t state = states[i % lanes];
        if (state >> 20 >= frequency) {
            words[--free_words] = static_cast<uint16_t>(state);
            state >>= 16;
        }
        states[i % lanes] = ((state / frequency) << kBits) + state % frequency + (entry & 0xffff);
    }
    *word_count = count - free_words;
    if (*word_count > 0) std::memmove(words, words + free_words, sizeof(uint16_t) * static_cast<size_t>(*word_count));
    return kDone;
}

extern "C" int sgs_rans_decode(const uint16_t* words, int64_t word_count, const uint32_t* states, int lanes,
                               const uint16_t* contexts, int64_t count, const uint16_t* frequencies,
                               int64_t context_count, int alphabet, uint8_t* symbols) {
    if (word_count < 0 || count < 0) return kRefused;
    Rows rows;
    const Result ready = prepare(contexts, count, frequencies, context_count, alphabet, true, &rows);
    if (ready != kDone) return ready;
    switch (lanes) {
        case 1: return decode<1>(words, word_count, states, contexts, count, rows, alphabet, symbols);
        case 4: return decode<4>(words, word_count, states, contexts, count, rows, alphabet, symbols);
        case 32: return decode<32>(words, word_count, states, contexts, count, rows, alphabet, symbols);
        default: return kRefused;
    }
}
