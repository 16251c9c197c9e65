// SPDX-License-Identifier: Apache-2.0
/** Icons of buttons, 24 by 24, as lines in the text's colour. */

import { made, madeSvg } from "./dom.js";

const PATHS = {
  play: "M8 5.5v13l10.5-6.5z",
  pause: "M8.5 5.5v13M15.5 5.5v13",
  again: "M5 12a7 7 0 1 0 2.2-5.1M5 4.5v4h4",
  back: "M17 6v12l-9-6zM6.5 6v12",
  forward: "M7 6v12l9-6zM17.5 6v12",
  loop: "M17 4l3 3-3 3M20 7H8a4 4 0 0 0-4 4v1M7 20l-3-3 3-3M4 17h12a4 4 0 0 0 4-4v-1",
  sound: "M4 9.5v5h3.5L12 18.5v-13L7.5 9.5zM15.5 9a4.2 4.2 0 0 1 0 6M18 6.5a8 8 0 0 1 0 11",
  silent: "M4 9.5v5h3.5L12 18.5v-13L7.5 9.5zM16 9.5l5 5M21 9.5l-5 5",
  cameras: "M4 8h10v8H4zM14 11l6-3v8l-6-3z",
  compare: "M12 3v18M4 6h16v12H4z",
  chart: "M5 19V11M10 19V5M15 19v-6M20 19V8",
  settings: "M4 7h9M17 7h3M4 17h3M11 17h9M15 4.8v4.4M9 14.8v4.4",
  link: "M10 14a4 4 0 0 0 5.7 0l3-3A4 4 0 0 0 13 5.3l-1 1M14 10a4 4 0 0 0-5.7 0l-3 3A4 4 0 0 0 11 18.7l1-1",
  photo: "M4 8h3.5l1.5-2.5h6L16.5 8H20v11H4zM12 16.5a3.25 3.25 0 1 0 0-6.5 3.25 3.25 0 0 0 0 6.5z",
  full: "M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5",
  vr: "M4 8h16v9h-5l-1.5-2.5h-3L9 17H4z",
  ar: "M12 8l4.5 2.5v5L12 18l-4.5-2.5v-5zM7.5 10.5L12 13l4.5-2.5M12 13v5M4 8V5h3M17 5h3v3",
  close: "M6 6l12 12M18 6L6 18",
  help: "M9.2 9a2.9 2.9 0 1 1 4.3 2.5c-1 .6-1.5 1.2-1.5 2.5M12 17.5v.5",
} as const;

export type IconName = keyof typeof PATHS;

export function icon(name: IconName): SVGSVGElement {
  const filled = name === "play" || name === "back" || name === "forward";
  const path = madeSvg("path", { d: PATHS[name], ...(filled ? { fill: "currentColor" } : {}) });
  return madeSvg("svg", { viewBox: "0 0 24 24", "aria-hidden": "true", class: "icon" }, path);
}

export function button(face: IconName, label: string, action: () => void, extra = ""): HTMLButtonElement {
  const element = made("button", { type: "button", part: "button", class: extra }, icon(face));
  relabel(element, label);
  element.addEventListener("click", action);
  return element;
}

/** @param spoken what screen readers say instead of the label */
export function relabel(element: HTMLElement, label: string, spoken = label): void {
  element.title = label;
  element.setAttribute("aria-label", spoken);
}
