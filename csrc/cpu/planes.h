// SPDX-License-Identifier: Apache-2.0
// A picture and its neighbours, as planes are swept through them (kernels/reference_motion.py).
#pragma once

#include <cstdint>

#include "structgstream.h"

namespace structgstream {

struct PlaneSweep {
    const float* picture;
    int height, width;
    const sgs_neighbour* neighbours;
    int neighbour_count;
    const double* homographies;  // [planes, neighbours, 3, 3]
    int64_t planes;
    int window;
    float noise;
    float* scores;  // [planes, height, width]
};

}  // namespace structgstream
