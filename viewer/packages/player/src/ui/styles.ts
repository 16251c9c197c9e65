// SPDX-License-Identifier: Apache-2.0
/** Styles of the player inside its shadow root: dark or light as the page, or by the attribute `theme`. */

const DARK = `
  --ground: #0d0e10; --panel: rgb(22 23 26 / 88%); --line: rgb(255 255 255 / 14%); --text: #f2f3f5; --soft: #a9adb6;
  --hover: rgb(255 255 255 / 10%); --accent: #6ea8ff; --key: rgb(255 255 255 / 55%); --lost: #ff7a6b; --live: #ff4d3d;
  --buffer: rgb(255 255 255 / 34%); --rail: rgb(255 255 255 / 16%);`;
const LIGHT = `
  --ground: #e9ebee; --panel: rgb(252 252 253 / 92%); --line: rgb(15 18 25 / 14%); --text: #15181e; --soft: #565c68;
  --hover: rgb(15 18 25 / 8%); --accent: #1f5fd6; --key: rgb(15 18 25 / 50%); --lost: #c2321f; --live: #d92c17;
  --buffer: rgb(15 18 25 / 32%); --rail: rgb(15 18 25 / 14%);`;

export const STYLES = `
:host { ${DARK} display: block; position: relative; min-width: 120px; min-height: 90px; aspect-ratio: 16 / 9; overflow: hidden;
  background: var(--ground); color: var(--text); font: 13px/1.4 system-ui, sans-serif; -webkit-text-size-adjust: none; }
:host([hidden]) { display: none; }
@media (prefers-color-scheme: light) { :host(:not([theme="dark"])) { ${LIGHT} } }
:host([theme="light"]) { ${LIGHT} }
*, *::before { box-sizing: border-box; }
.stage, canvas, .overlay { position: absolute; inset: 0; width: 100%; height: 100%; }
.stage { touch-action: none; cursor: grab; outline: none; user-select: none; -webkit-user-select: none; }
.stage:active { cursor: grabbing; }
canvas { display: block; }
.poster { position: absolute; inset: 0; width: 100%; height: 100%; object-fit: contain; pointer-events: none; }
.children { position: absolute; inset: 0; pointer-events: none; } ::slotted(*) { pointer-events: auto; }
.overlay { pointer-events: none; }
.frustum path { fill: rgb(0 0 0 / 1%); stroke: #fff; stroke-opacity: .75; stroke-width: 1.25; pointer-events: all; cursor: pointer;
  paint-order: stroke; vector-effect: non-scaling-stroke; }
.frustum.heldout path { stroke-dasharray: 4 3; }
.frustum:hover path { stroke: var(--accent); stroke-opacity: 1; fill: rgb(110 168 255 / 18%); }
.frustum text { fill: #fff; font-size: 11px; text-anchor: middle; paint-order: stroke; stroke: rgb(0 0 0 / 65%); stroke-width: 3px; }
.glass { background: var(--panel); border: 1px solid var(--line); border-radius: 10px; backdrop-filter: blur(14px);
  -webkit-backdrop-filter: blur(14px); }
.bar, .panel, .note, .middle { direction: ltr; }
.bar { position: absolute; left: 10px; right: 10px; bottom: 10px; padding: 2px 6px 4px; transition: opacity .2s; }
.row { display: flex; align-items: center; gap: 2px; min-width: 0; }
.space { flex: 1; min-width: 0; }
button, select { font: inherit; color: inherit; }
button { background: none; border: 0; border-radius: 7px; min-width: 32px; height: 32px; padding: 0 6px; display: inline-flex;
  align-items: center; justify-content: center; gap: 6px; cursor: pointer; flex: none; }
@media (hover: hover) { button:hover, select:hover { background: var(--hover); } }
button:disabled { opacity: .4; cursor: default; background: none; }
button[aria-pressed="true"], button[aria-expanded="true"] { color: var(--accent); }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 1px; }
.icon { width: 20px; height: 20px; fill: none; stroke: currentColor; stroke-width: 1.8; stroke-linecap: round; stroke-linejoin: round; }
.edge { font-size: 11px; font-weight: 600; font-variant-numeric: tabular-nums; color: var(--soft); white-space: nowrap; }
.edge::before { content: ""; width: 7px; height: 7px; border-radius: 50%; background: var(--soft); }
.edge.at { color: var(--text); } .edge.at::before { background: var(--live); }
.time { font-variant-numeric: tabular-nums; white-space: nowrap; padding: 0 8px; overflow: hidden; text-overflow: ellipsis;
  flex: 0 1 auto; min-width: 0; }
.time .soft { color: var(--soft); }
.timeline { position: relative; height: 18px; margin: 0 6px; cursor: pointer; touch-action: none; border-radius: 4px; }
.timeline canvas { position: absolute; inset: 0; width: 100%; height: 100%; }
.tip { position: absolute; bottom: 20px; transform: translateX(-50%); padding: 2px 7px; border-radius: 6px; font-size: 12px;
  font-variant-numeric: tabular-nums; white-space: nowrap; pointer-events: none; }
select { background: none; border: 1px solid transparent; border-radius: 7px; height: 32px; padding: 0 4px; cursor: pointer; }
.bar select { width: 62px; }
.bar input { width: 70px; accent-color: var(--accent); }
option { background: Canvas; color: CanvasText; }
.panel { position: absolute; right: 10px; top: 10px; bottom: 80px; width: min(290px, calc(100% - 20px)); overflow: auto; padding: 10px 12px;
  overscroll-behavior: contain; height: fit-content; max-height: calc(100% - 90px); }
.panel h2 { font-size: 12px; font-weight: 600; margin: 0 0 6px; display: flex; align-items: center; justify-content: space-between; }
.panel h3 { font-size: 11px; font-weight: 600; margin: 12px 0 4px; color: var(--soft); }
.panel label { display: flex; justify-content: space-between; align-items: center; gap: 8px; min-height: 36px; }
.panel label select { border-color: var(--line); }
.list { display: grid; grid-template-columns: repeat(auto-fill, minmax(76px, 1fr)); gap: 4px; }
.list button { border: 1px solid var(--line); height: 30px; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; display: block; }
.list button.heldout { border-style: dashed; }
.list button[aria-current="true"] { border-color: var(--accent); color: var(--accent); }
.facts { display: grid; grid-template-columns: 1fr auto; gap: 2px 10px; margin: 0; font-variant-numeric: tabular-nums; }
.facts dt { color: var(--soft); } .facts dd { margin: 0; text-align: right; }
.field { display: grid; grid-template-columns: 1fr auto; gap: 0 8px; font-size: 12px; font-variant-numeric: tabular-nums; margin-top: 4px; }
.field i { grid-column: 1 / 3; height: 3px; border-radius: 2px; background: var(--rail); overflow: hidden; }
.field i::before { content: ""; display: block; height: 100%; width: var(--share); background: var(--accent); }
.keys { display: grid; grid-template-columns: auto 1fr; gap: 4px 12px; margin: 0; }
.keys dd { margin: 0; color: var(--soft); }
kbd { font: 11px/1.2 ui-monospace, monospace; border: 1px solid var(--line); border-radius: 4px; padding: 1px 5px; }
.note { position: absolute; left: 50%; top: 14px; transform: translateX(-50%); max-width: min(560px, calc(100% - 28px)); padding: 7px 12px;
  display: flex; gap: 8px; align-items: center; }
.note button { min-width: 24px; height: 24px; padding: 0; } .note .icon { width: 14px; height: 14px; }
.note.bad { border-color: var(--lost); }
.middle { position: absolute; inset: 0; display: grid; place-content: center; justify-items: center; gap: 12px; padding: 24px; text-align: center;
  pointer-events: none; }
.middle p { margin: 0; max-width: 46ch; }
.middle.bad, .middle[data-is="loading"] { background: var(--ground); }
.middle.bad { pointer-events: auto; }
.posted .middle[data-is="loading"] { background: none; place-content: end center; }
.middle .soft { color: var(--soft); font-variant-numeric: tabular-nums; }
progress { appearance: none; width: min(220px, 60vw); height: 3px; border: 0; border-radius: 2px; background: var(--rail); overflow: hidden; }
progress::-webkit-progress-bar { background: var(--rail); } progress::-webkit-progress-value { background: var(--accent); }
progress::-moz-progress-bar { background: var(--accent); }
.big { width: 68px; height: 68px; border-radius: 50%; pointer-events: auto; } .big .icon { width: 30px; height: 30px; }
.compare { position: absolute; overflow: hidden; pointer-events: none; }
.compare img { position: absolute; inset: 0; width: 100%; height: 100%; clip-path: inset(0 calc(100% - var(--split)) 0 0); }
.compare .split { position: absolute; top: 0; bottom: 0; left: var(--split); width: 32px; margin-left: -16px; pointer-events: auto;
  cursor: ew-resize; touch-action: none; min-width: 0; height: auto; padding: 0; border-radius: 0; }
.compare .split::before { content: ""; width: 2px; height: 100%; background: #fff; box-shadow: 0 0 4px rgb(0 0 0 / 60%); }
.compare span { position: absolute; top: 8px; padding: 1px 8px; border-radius: 6px; font-size: 12px; background: rgb(0 0 0 / 55%); color: #fff; }
.compare .left { left: 8px; } .compare .right { right: 8px; }
.drop { position: absolute; inset: 10px; border: 2px dashed var(--accent); border-radius: 12px; display: grid; place-content: center;
  pointer-events: none; background: var(--panel); }
.idle .bar { opacity: 0; } .idle .bar:focus-within { opacity: 1; } .idle .stage { cursor: none; }
.narrow .wide { display: none; }
.tiny .time .soft, .tiny .medium { display: none; }
.more { display: none; flex-wrap: wrap; gap: 4px; margin-top: 8px; } .narrow .more { display: flex; }
.more button, .file { border: 1px solid var(--line); }
.file { margin-top: 8px; width: 100%; }
.remark { color: var(--soft); font-size: 12px; margin: 8px 0 0; }
.embed .noembed { display: none; }
[hidden] { display: none !important; }
.quiet { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); white-space: nowrap; }
@media (prefers-reduced-motion: reduce) { * { transition: none !important; } }
`;
