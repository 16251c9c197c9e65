// SPDX-License-Identifier: Apache-2.0
/** The example in a page that counts what is on the GPU; the import of the counts comes first. */

import { exposed } from "../../gl/test/support/examplePage.ts";
import { clips, removeStreams } from "../examples/main.ts";

Object.assign(globalThis, { stage: exposed(clips, removeStreams) });
