// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace structgstream {

// Input and output of the lift from flow to displacements (kernels/reference_motion.py): dynamic primitives (`movers`) in
// `views`, and `targets` with `neighbour_count` of these each.
struct FlowLift {
    const float *centers, *weights, *flows;      // [E,3], [V,E], [V,E,2]
    const float *viewmats, *Ks, *near;           // [V,4,4], [V,3,3], [V]
    const int64_t* neighbours;                   // [T,N]
    const float *affinities, *priors;            // [T,N], [T,3]
    int64_t movers, targets;
    int views, neighbour_count;
    float share;                                 // share of a view's flow that must agree
    float *displacements, *inlier_share;         // [T,3], [T]
    int64_t* agreeing_views;                     // [T]
};

}  // namespace structgstream
