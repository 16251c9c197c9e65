// SPDX-License-Identifier: Apache-2.0

export { StreamSplats } from "./streamSplats.js";
