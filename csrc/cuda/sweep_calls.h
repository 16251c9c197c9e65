// SPDX-License-Identifier: Apache-2.0
// The interface of sweep.h, implemented with the elements of sweep_elements.h. sweep.cu compiles it for a GPU,
// emulate_elements.cpp for a CPU.
#pragma once

#include "sweep_elements.h"

int sgs_cuda_sweep(
    const sgs_cuda_sweep_view* views, int view_count, int view_index, const int64_t* pixels, const float* farthest,
    int count, int planes, int least_supports, float most_contradictions, float* votes, float* depths, float* costs,
    void* stream) {
    using namespace structgstream::cuda;
    const Rays rays = {views[view_index], pixels, farthest, planes};
    const int64_t points = static_cast<int64_t>(count) * planes;
    for (int v = 0; v < view_count; ++v) {
        if (v == view_index) continue;
        const int error = for_each(SweepVote{rays, views[v], points, votes}, points, stream);
        if (error) return error;
    }
    const SweepBest best = {rays, points, votes, least_supports, most_contradictions, depths, costs};
    return for_each(best, count, stream);
}
