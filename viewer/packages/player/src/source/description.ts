// SPDX-License-Identifier: Apache-2.0
/** Where a stream comes from, as values that go between threads. */

import type { FileEntry, Manifest, PageContent, PageEntry, Quality } from "./manifest.js";

/** A stream to play; `name` is what messages call it. */
export type SourceDescription =
  | {
      readonly kind: "url";
      readonly url: string;
      readonly name: string;
      /** Refuse other origins, also those that a server redirects to: for addresses that are not the page's own. */
      readonly sameOrigin?: boolean;
    }
  /** A segments folder by its manifest, or several of one stream by the list of them. */
  | {
      readonly kind: "segments";
      readonly url: string;
      readonly name: string;
      readonly sameOrigin?: boolean;
      /** Whether it is of the page's own origin. */
      readonly own: boolean;
    }
  | { readonly kind: "blob"; readonly blob: Blob; readonly name: string }
  | { readonly kind: "base64"; readonly text: string; readonly name: string };

/** What the decode worker asks of the fetch worker; `id` is its own number for one reading. */
export type ReadRequest =
  | { readonly type: "open"; readonly source: SourceDescription }
  /** The manifest there, and each newer one. */
  | { readonly type: "manifests"; readonly id: number; readonly url: string; readonly name: string }
  /** A page of the manifest there. */
  | { readonly type: "page"; readonly id: number; readonly url: string; readonly entry: PageEntry }
  /** Bytes from `start` to before `end`; `wholeIfNeeded` takes the whole file where a server gives no ranges. */
  | {
      readonly type: "read";
      readonly id: number;
      readonly start: number;
      readonly end: number;
      readonly wholeIfNeeded: boolean;
      /** Of this file beside the manifest `url`, and not of the source that was opened. */
      readonly of?: StoredPlace | undefined;
    }
  /** Everything from `start` on, and then what is appended to the file. */
  | { readonly type: "follow"; readonly id: number; readonly start: number }
  | { readonly type: "cancel"; readonly id: number };

/** A file beside a manifest; one that is `small` is given once it has been compared with what is stated of it. */
export interface StoredPlace {
  readonly url: string;
  readonly entry: FileEntry;
  readonly small: boolean;
}

/** What the fetch worker answers. */
export type ReadReply =
  /** The first byte that comes is that at `start`; without ranges the whole file comes. */
  | {
      readonly type: "begin";
      readonly id: number;
      readonly start: number;
      readonly fileBytes: number | undefined;
      readonly ranged: boolean;
    }
  | { readonly type: "bytes"; readonly id: number; readonly bytes: Uint8Array }
  | { readonly type: "end"; readonly id: number }
  /** Nothing new, or no connection: it looks again in so many seconds. */
  | { readonly type: "waiting"; readonly id: number; readonly seconds: number; readonly problem: string | undefined }
  | { readonly type: "manifest"; readonly id: number; readonly manifest: Manifest }
  | { readonly type: "qualities"; readonly id: number; readonly qualities: readonly Quality[] }
  | { readonly type: "page"; readonly id: number; readonly content: PageContent }
  /** After waiting for a connection: there is one again. */
  | { readonly type: "recovered"; readonly id: number }
  /** A `temporary` failure may go away by itself. */
  | { readonly type: "failed"; readonly id: number; readonly message: string; readonly temporary: boolean };
