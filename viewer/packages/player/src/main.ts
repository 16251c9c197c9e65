// SPDX-License-Identifier: Apache-2.0

import { type ElementEvents, StructgstreamPlayer } from "./element.js";
import type { XrMode } from "./xr/session.js";

export type { EngineEvents, TimeRange } from "./engine/events.js";
export type { MediaEvents, Ranges } from "./mediaEvents.js";
export type { PlayerEvents } from "./player.js";
export { type ElementEvents, StructgstreamPlayer, type XrMode };

// A page may contain the module twice, as notebooks do.
if (!customElements.get("structgstream-player")) customElements.define("structgstream-player", StructgstreamPlayer);
