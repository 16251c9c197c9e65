// SPDX-License-Identifier: Apache-2.0

import { testExample } from "../../gl/test/support/exampleTests.ts";

testExample(new URL("example.ts", import.meta.url));
