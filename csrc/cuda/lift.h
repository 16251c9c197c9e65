/* SPDX-License-Identifier: Apache-2.0 */
/* The C interface of the lift from flow to displacements on a GPU. `lift` lies in the host's memory, what it points to in the GPU's;
 * `stream` is a cudaStream_t. Waits for nothing. Returns 0, or CUDA's error number. */
#pragma once

#include "../cpu/lift.h"

extern "C" {

int sgs_cuda_lift(const structgstream::FlowLift* lift, void* stream);

}  // extern "C"
