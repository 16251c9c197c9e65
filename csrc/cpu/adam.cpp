// SPDX-License-Identifier: Apache-2.0
// One step of Adam (Kingma and Ba, 2015), in place, in one pass over memory.

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "vec.h"

namespace structgstream {
namespace SGS_ISA {
namespace {

struct Rates {
    float beta1, beta2, rest1, rest2, step_size, correction, eps;  // rest: one minus beta, rounded once
};

void step(float* param, const float* grad, float* first, float* second, int64_t count, const Rates& r) {
    for (int64_t i = 0; i < count; ++i) {
        const float g = grad[i];
        const float m = r.beta1 * first[i] + r.rest1 * g;
        const float v = r.beta2 * second[i] + r.rest2 * g * g;
        first[i] = m;
        second[i] = v;
        param[i] -= r.step_size * m / (std::sqrt(v) * r.correction + r.eps);
    }
}

}  // namespace

// All tensors hold `count` floats.
void adam_step(
    float* param, const float* grad, float* first, float* second, int64_t count, double lr, int64_t steps, double beta1,
    double beta2, double eps, int threads) {
    const Rates rates{
        static_cast<float>(beta1),
        static_cast<float>(beta2),
        static_cast<float>(1.0 - beta1),
        static_cast<float>(1.0 - beta2),
        static_cast<float>(lr / (1.0 - std::pow(beta1, static_cast<double>(steps)))),
        static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(beta2, static_cast<double>(steps)))),
        static_cast<float>(eps)};
    constexpr int64_t kSpan = 1 << 14;
    constexpr int64_t kWorthThreads = 1 << 22;  // Below this, waking a thread costs more than it saves.
    const int64_t chunks = (count + kSpan - 1) / kSpan;
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1 && count >= kWorthThreads)
    for (int64_t n = 0; n < chunks; ++n) {
        const int64_t at = n * kSpan;
        step(param + at, grad + at, first + at, second + at, std::min(kSpan, count - at), rates);
    }
}

}  // namespace SGS_ISA
}  // namespace structgstream
