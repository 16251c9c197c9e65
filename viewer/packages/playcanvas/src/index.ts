// SPDX-License-Identifier: Apache-2.0

export { RENDERING, StreamClip, StreamSplats } from "./streamSplats.js";
