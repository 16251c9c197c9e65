// SPDX-License-Identifier: Apache-2.0

export { blurAmount, RENDERING, StreamClip, StreamSplats } from "./streamSplats.js";
