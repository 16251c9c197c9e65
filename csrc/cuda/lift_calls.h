// SPDX-License-Identifier: Apache-2.0
// The interface of lift.h; the formulas are those of csrc/cpu/lift.cpp. lift.cu compiles it for a GPU, emulate_elements.cpp for
// a CPU.
#pragma once

#include <cmath>

#include "element.h"
#include "lift.h"

namespace structgstream {
namespace cuda {

// A neighbour in a view: two rows of a Jacobian, the flow, the weight, and 1 / squared tolerance.
struct Term {
    float J[2][3], f[2], weight, falling;

    // Squared residual of the flow under d, in squared tolerances.
    SGS_ELEMENT float error(const float* d) const {
        const float x = J[0][0] * d[0] + J[0][1] * d[1] + J[0][2] * d[2] - f[0];
        const float y = J[1][0] * d[0] + J[1][1] * d[1] + J[1][2] * d[2] - f[1];
        return (x * x + y * y) * falling;
    }
};

// A thread is a target.
struct LiftTarget {
    FlowLift lift;

    // Whether neighbour n of a target weighs anything in a view.
    SGS_ELEMENT bool term(int64_t target, int view, int n, Term& t) const {
        const int64_t at = target * lift.neighbour_count + n, mover = lift.neighbours[at];
        const int64_t observed = view * lift.movers + mover;
        const float *V = lift.viewmats + 16 * view, *K = lift.Ks + 9 * view, *m = lift.centers + 3 * mover;
        t.weight = lift.weights[observed] * lift.affinities[at];
        float p[3];
        for (int i = 0; i < 3; ++i) p[i] = V[4 * i] * m[0] + V[4 * i + 1] * m[1] + V[4 * i + 2] * m[2] + V[4 * i + 3];
        if (!(t.weight > 0.0f) || !(p[2] > lift.near[view])) return false;
        for (int row = 0; row < 2; ++row) {
            t.f[row] = lift.flows[2 * observed + row];
            for (int i = 0; i < 3; ++i)
                t.J[row][i] = K[4 * row] / p[2] * (V[4 * row + i] - p[row] / p[2] * V[8 + i]);
        }
        const float tolerance = 1.0f + 0.1f * sqrtf(t.f[0] * t.f[0] + t.f[1] * t.f[1]);
        t.falling = 1.0f / (tolerance * tolerance);
        return true;
    }

    template <typename Visit>
    SGS_ELEMENT void each_term(int64_t target, int view, const Visit& visit) const {
        Term t;
        for (int n = 0; n < lift.neighbour_count; ++n)
            if (term(target, view, n, t)) visit(t);
    }

    SGS_ELEMENT void operator()(int64_t target) const {
        const float* prior = lift.priors + 3 * target;
        float d[3] = {prior[0], prior[1], prior[2]}, total = 0.0f, squares = 0.0f;
        for (int view = 0; view < lift.views; ++view)
            each_term(target, view, [&](const Term& t) {
                float length = 0.0f;
                for (int i = 0; i < 3; ++i) length += t.J[0][i] * t.J[0][i] + t.J[1][i] * t.J[1][i];
                total += t.weight, squares += t.weight * length;
            });
        const float stiffness = squares / (2.0f * fmaxf(total, 1e-12f));
        const float scales[] = {0.0f, 4.0f, 2.5f, 1.5f, 1.5f, 1.0f, 1.0f};  // reference_motion.ROBUST_SCALES after none
        for (int round = 0; round < 7 && total > 0.0f; ++round) refine(target, scales[round], stiffness, prior, d);
        float agreed_in_all = 0.0f;
        int64_t views = 0;
        for (int view = 0; view < lift.views; ++view) {
            float of_view = 0.0f, agreed = 0.0f;
            each_term(target, view, [&](const Term& t) {
                of_view += t.weight, agreed += t.error(d) < 1.5f * 1.5f ? t.weight : 0.0f;
            });
            agreed_in_all += agreed, views += agreed > lift.share * of_view;
        }
        for (int i = 0; i < 3; ++i) lift.displacements[3 * target + i] = d[i];
        lift.inlier_share[target] = agreed_in_all / fmaxf(total, 1e-12f);
        lift.agreeing_views[target] = views;
    }

    // One round: weights from the residual of each term under d (scale 0: equal weights), then the best d for them.
    SGS_ELEMENT void refine(int64_t target, float scale, float stiffness, const float* prior, float* d) const {
        const float falling = scale > 0.0f ? 1.0f / (scale * scale) : 0.0f;
        float A[6] = {}, b[3] = {}, sum = 0.0f;  // A: xx xy xz yy yz zz
        for (int view = 0; view < lift.views; ++view)
            each_term(target, view, [&](const Term& t) {
                const float q = 1.0f + t.error(d) * falling, w = t.weight / (q * q);
                int n = 0;
                for (int i = 0; i < 3; ++i) {
                    for (int j = i; j < 3; ++j, ++n) A[n] += w * (t.J[0][i] * t.J[0][j] + t.J[1][i] * t.J[1][j]);
                    b[i] += w * (t.J[0][i] * t.f[0] + t.J[1][i] * t.f[1]);
                }
                sum += w;
            });
        // Cholesky; the ridge makes A positive definite.
        const double ridge = (0.02f * sum + 0.05f) * fmaxf(stiffness, 1e-12f);
        const double l00 = sqrt(A[0] + ridge), l10 = A[1] / l00, l20 = A[2] / l00;
        const double l11 = sqrt(A[3] + ridge - l10 * l10), l21 = (A[4] - l20 * l10) / l11;
        const double l22 = sqrt(A[5] + ridge - l20 * l20 - l21 * l21);
        const double y0 = (b[0] + ridge * prior[0]) / l00, y1 = (b[1] + ridge * prior[1] - l10 * y0) / l11;
        const double x2 = (b[2] + ridge * prior[2] - l20 * y0 - l21 * y1) / (l22 * l22), x1 = (y1 - l21 * x2) / l11;
        d[0] = static_cast<float>((y0 - l10 * x1 - l20 * x2) / l00);
        d[1] = static_cast<float>(x1), d[2] = static_cast<float>(x2);
    }
};

}  // namespace cuda
}  // namespace structgstream

int sgs_cuda_lift(const structgstream::FlowLift* lift, void* stream) {
    using namespace structgstream::cuda;
    return for_each(LiftTarget{*lift}, lift->targets, stream);
}
