// SPDX-License-Identifier: Apache-2.0
// Features that the MLPs read: those of frame 0 plus a change in a basis, and the gradient of its coefficients.

#include <cstdint>

#include "vec.h"

namespace structgstream {
namespace SGS_ISA {

// folded [M, D] = features [M, D] + appearance [M, R] basis [R, D].
void fold_appearance(
    const float* features, const float* appearance, const float* basis, int64_t count, int size, int rank,
    float* folded) {
    for (int64_t m = 0; m < count; ++m) {
        const float* weights = appearance + m * rank;
        int d = 0;
        for (; d + kLanes <= size; d += kLanes) {
            vf sum = splat(0.0f);
            for (int r = 0; r < rank; ++r) sum += splat(weights[r]) * load(basis + r * size + d);
            store(folded + m * size + d, load(features + m * size + d) + sum);
        }
        for (; d < size; ++d) {
            float sum = 0.0f;
            for (int r = 0; r < rank; ++r) sum += weights[r] * basis[r * size + d];
            folded[m * size + d] = features[m * size + d] + sum;
        }
    }
}

// gradient [M, R] = to_folded [M, D] times the transposed basis.
void fold_appearance_backward(
    const float* to_folded, const float* basis, int64_t count, int size, int rank, float* gradient) {
    for (int64_t m = 0; m < count; ++m)
        for (int r = 0; r < rank; ++r) {
            const float *row = to_folded + m * size, *along = basis + r * size;
            vf lanes = splat(0.0f);
            int d = 0;
            for (; d + kLanes <= size; d += kLanes) lanes += load(row + d) * load(along + d);
            float partial[kLanes], sum = 0.0f;
            store(partial, lanes);
            for (int l = 0; l < kLanes; ++l) sum += partial[l];
            for (; d < size; ++d) sum += row[d] * along[d];
            gradient[m * rank + r] = sum;
        }
}

}  // namespace SGS_ISA
}  // namespace structgstream
