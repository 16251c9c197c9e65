// SPDX-License-Identifier: Apache-2.0
// Displacements in space from flow in pictures: iteratively reweighted least squares for each target.

#include "lift.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "vec.h"

namespace structgstream {
namespace SGS_ISA {
namespace {

// See kernels/reference_motion.py for the units and reasons.
constexpr float kLeastTolerance = 1.0f, kToleranceShare = 0.1f;
constexpr float kRobustScales[] = {4.0f, 2.5f, 1.5f, 1.5f, 1.0f, 1.0f};
constexpr float kInlierScale = 1.5f;
constexpr float kPriorShare = 0.02f, kPriorFloor = 0.05f, kTiny = 1e-12f;

// Data of one neighbour in one view: two rows of a Jacobian, the flow, and the weight. One array each, padded with
// terms of weight zero to whole vectors.
constexpr int kColumns = 10;
struct Terms {
    std::vector<float> columns[kColumns];  // J00 J01 J02 J10 J11 J12 fx fy w, 1 / squared tolerance
    std::vector<int> view_ends;
    int count = 0;

    void clear() {
        count = 0;
        view_ends.clear();
        for (auto& column : columns) column.clear();
    }
    void add(const float* values) {
        for (int i = 0; i < kColumns; ++i) columns[i].push_back(values[i]);
        ++count;
    }
    void pad() {
        while (columns[8].size() % kLanes)
            for (auto& column : columns) column.push_back(0.0f);
    }
};

// Jacobian of a point's projection, pixels per unit. False if the point is in front of the near plane.
bool jacobian(const FlowLift& lift, int view, const float* center, float* J) {
    const float *V = lift.viewmats + 16 * view, *K = lift.Ks + 9 * view;
    float p[3];
    for (int i = 0; i < 3; ++i)
        p[i] = V[4 * i] * center[0] + V[4 * i + 1] * center[1] + V[4 * i + 2] * center[2] + V[4 * i + 3];
    if (!(p[2] > lift.near[view])) return false;
    for (int i = 0; i < 3; ++i) {
        J[i] = K[0] / p[2] * (V[i] - p[0] / p[2] * V[8 + i]);
        J[3 + i] = K[4] / p[2] * (V[4 + i] - p[1] / p[2] * V[8 + i]);
    }
    return true;
}

void gather(const FlowLift& lift, int64_t target, Terms& terms) {
    terms.clear();
    for (int view = 0; view < lift.views; ++view) {
        for (int n = 0; n < lift.neighbour_count; ++n) {
            const int64_t mover = lift.neighbours[target * lift.neighbour_count + n];
            const int64_t at = view * lift.movers + mover;
            float values[kColumns];
            values[8] = lift.weights[at] * lift.affinities[target * lift.neighbour_count + n];
            if (!(values[8] > 0.0f) || !jacobian(lift, view, lift.centers + 3 * mover, values)) continue;
            values[6] = lift.flows[2 * at], values[7] = lift.flows[2 * at + 1];
            const float length = std::sqrt(values[6] * values[6] + values[7] * values[7]);
            const float tolerance = kLeastTolerance + kToleranceShare * length;
            values[9] = 1.0f / (tolerance * tolerance);
            terms.add(values);
        }
        terms.view_ends.push_back(terms.count);
    }
    terms.pad();
}

float sum(vf v) {
    float lanes[kLanes], total = 0.0f;
    store(lanes, v);
    for (float lane : lanes) total += lane;
    return total;
}

// Squared residuals of the flow under d, in units of each term's tolerance.
vf squared_error(const Terms& terms, int i, const float* d) {
    const auto& c = terms.columns;
    const vf x = load(&c[0][i]) * d[0] + load(&c[1][i]) * d[1] + load(&c[2][i]) * d[2] - load(&c[6][i]);
    const vf y = load(&c[3][i]) * d[0] + load(&c[4][i]) * d[1] + load(&c[5][i]) * d[2] - load(&c[7][i]);
    return (x * x + y * y) * load(&c[9][i]);
}

// Solves the symmetric A x = b by Cholesky's method; A has a ridge, so it is positive definite.
void solve(const double (&A)[6], const double (&b)[3], float* x) {  // A: xx xy xz yy yz zz
    const double l00 = std::sqrt(A[0]), l10 = A[1] / l00, l20 = A[2] / l00;
    const double l11 = std::sqrt(A[3] - l10 * l10), l21 = (A[4] - l20 * l10) / l11;
    const double l22 = std::sqrt(A[5] - l20 * l20 - l21 * l21);
    const double y0 = b[0] / l00, y1 = (b[1] - l10 * y0) / l11, y2 = (b[2] - l20 * y0 - l21 * y1) / l22;
    const double x2 = y2 / l22, x1 = (y1 - l21 * x2) / l11;
    x[0] = static_cast<float>((y0 - l10 * x1 - l20 * x2) / l00);
    x[1] = static_cast<float>(x1), x[2] = static_cast<float>(x2);
}

// One round: weights from the residual of each term under d (scale 0: equal weights), then the best d for them.
void refine(const Terms& terms, float scale, float stiffness, const float* prior, float* d) {
    vf sums[10];
    for (vf& s : sums) s = splat(0.0f);
    const auto& c = terms.columns;
    const float falling = scale > 0.0f ? 1.0f / (scale * scale) : 0.0f;
    for (int i = 0; i < static_cast<int>(c[8].size()); i += kLanes) {
        const vf q = 1.0f + squared_error(terms, i, d) * falling;
        const vf w = load(&c[8][i]) / (q * q);
        const vf j0 = load(&c[0][i]), j1 = load(&c[1][i]), j2 = load(&c[2][i]);
        const vf k0 = load(&c[3][i]), k1 = load(&c[4][i]), k2 = load(&c[5][i]);
        const vf wx = w * load(&c[6][i]), wy = w * load(&c[7][i]);
        sums[0] += w * (j0 * j0 + k0 * k0), sums[1] += w * (j0 * j1 + k0 * k1), sums[2] += w * (j0 * j2 + k0 * k2);
        sums[3] += w * (j1 * j1 + k1 * k1), sums[4] += w * (j1 * j2 + k1 * k2), sums[5] += w * (j2 * j2 + k2 * k2);
        sums[6] += wx * j0 + wy * k0, sums[7] += wx * j1 + wy * k1, sums[8] += wx * j2 + wy * k2;
        sums[9] += w;
    }
    const double ridge = (kPriorShare * sum(sums[9]) + kPriorFloor) * std::max(stiffness, kTiny);
    double A[6], b[3];
    for (int i = 0; i < 6; ++i) A[i] = sum(sums[i]);
    for (int i = 0; i < 3; ++i) b[i] = sum(sums[6 + i]) + ridge * prior[i];
    A[0] += ridge, A[3] += ridge, A[5] += ridge;
    solve(A, b, d);
}

void lift_target(const FlowLift& lift, int64_t target, Terms& terms) {
    gather(lift, target, terms);
    const float* prior = lift.priors + 3 * target;
    float* d = lift.displacements + 3 * target;
    std::copy_n(prior, 3, d);
    lift.inlier_share[target] = 0.0f, lift.agreeing_views[target] = 0;
    if (terms.count == 0) return;
    vf weight = splat(0.0f), squares = splat(0.0f);
    const auto& c = terms.columns;
    for (int i = 0; i < static_cast<int>(c[8].size()); i += kLanes) {
        vf length = splat(0.0f);
        for (int k = 0; k < 6; ++k) length += load(&c[k][i]) * load(&c[k][i]);
        weight += load(&c[8][i]), squares += load(&c[8][i]) * length;
    }
    const float total = sum(weight), stiffness = sum(squares) / (2.0f * std::max(total, kTiny));
    refine(terms, 0.0f, stiffness, prior, d);
    for (float scale : kRobustScales) refine(terms, scale, stiffness, prior, d);
    float agreed_in_all = 0.0f;
    int i = 0;
    for (int end : terms.view_ends) {
        float of_view = 0.0f, agreed = 0.0f;
        for (; i < end; ++i) {
            const float x = c[0][i] * d[0] + c[1][i] * d[1] + c[2][i] * d[2] - c[6][i];
            const float y = c[3][i] * d[0] + c[4][i] * d[1] + c[5][i] * d[2] - c[7][i];
            of_view += c[8][i];
            if ((x * x + y * y) * c[9][i] < kInlierScale * kInlierScale) agreed += c[8][i];
        }
        agreed_in_all += agreed;
        lift.agreeing_views[target] += agreed > lift.share * of_view;
    }
    lift.inlier_share[target] = agreed_in_all / std::max(total, kTiny);
}

}  // namespace

void lift_flow(const FlowLift& lift, int threads) {
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        Terms terms;
#pragma omp for schedule(dynamic, 64)
        for (int64_t target = 0; target < lift.targets; ++target) lift_target(lift, target, terms);
    }
}

}  // namespace SGS_ISA
}  // namespace structgstream
