# SPDX-License-Identifier: Apache-2.0
"""Whether pictures, poses, colours and times of a capture belong together, and which camera is off."""
