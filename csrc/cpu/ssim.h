// SPDX-License-Identifier: Apache-2.0
// The arguments of the loss, and the parts of the picture over which it is computed.
#pragma once

#include <cstdint>
#include <vector>

namespace structgstream {

struct Pictures {
    const float* image;        // [H, W, 3]
    const float* target;       // either this
    const uint8_t* target_u8;  // or this
    const float* gains;        // [3]: gains * image + biases is compared; or both null
    const float* biases;
    int height;
    int width;
};

struct Part {
    int left, top, right, bottom;  // pixels, half open
    double* row_l1;                // [bottom - top] sums of the rows
    double* row_ssim;
};

// Parts of a picture with the memory of their sums.
class Parts {
  public:
    // tiles: null, or a byte for each tile of kTile pixels, zero where the picture does not count.
    Parts(int height, int width, const uint8_t* tiles, int threads);
    const Part* data() const { return parts_.data(); }
    int count() const { return static_cast<int>(parts_.size()); }
    // Adds the parts' sums, in order of the parts, to the sums of the picture's rows.
    void add_to(double* row_l1, double* row_ssim) const;

  private:
    std::vector<Part> parts_;
    std::vector<double> sums_;
};

}  // namespace structgstream
