// SPDX-License-Identifier: Apache-2.0
/** A button and a slider for streams that play together, for the examples of the packages. */

import type { Playback } from "@structgstream/core";

export interface Controls {
  readonly element: HTMLElement;
  /** Shows the present time; called before each picture. */
  update(): void;
}

export function controlsOf(playbacks: readonly Playback[]): Controls {
  const [element, button, slider] = ["div", "button", "input"].map((name) => document.createElement(name)) as [
    HTMLDivElement,
    HTMLButtonElement,
    HTMLInputElement,
  ];
  const [first] = playbacks;
  if (!first) throw new RangeError("there is no stream to control");
  button.onclick = () => {
    const { paused } = first;
    for (const playback of playbacks) {
      if (paused) playback.play();
      else playback.pause();
    }
  };
  Object.assign(slider, { type: "range", min: "0", max: String(first.duration), step: "any" });
  slider.oninput = () => {
    for (const playback of playbacks) playback.seek(slider.valueAsNumber);
  };
  element.append(button, slider);
  const update = () => {
    button.textContent = first.paused ? "Play" : "Pause";
    slider.valueAsNumber = first.currentTime;
  };
  return { element, update };
}
