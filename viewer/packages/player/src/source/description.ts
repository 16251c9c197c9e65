// SPDX-License-Identifier: Apache-2.0
/** Sources of streams and requests, as values that can be sent between threads. */

import type { FileEntry, Manifest, PageContent, PageEntry, Quality } from "./manifest.js";

/** A stream to play; `name` is its name in messages. */
export type SourceDescription =
  | {
      readonly kind: "url";
      readonly url: string;
      readonly name: string;
      /** Refuse other origins, including those of redirects: for addresses from a link. */
      readonly sameOrigin?: boolean;
    }
  /** A segments folder by its manifest, or the renditions of a stream by their list. */
  | {
      readonly kind: "segments";
      readonly url: string;
      readonly name: string;
      readonly sameOrigin?: boolean;
      /** Whether it has the page's own origin. */
      readonly own: boolean;
    }
  | { readonly kind: "blob"; readonly blob: Blob; readonly name: string }
  | { readonly kind: "base64"; readonly text: string; readonly name: string };

/** Requests of the decode worker to the fetch worker; `id` identifies a reading. */
export type ReadRequest =
  | { readonly type: "open"; readonly source: SourceDescription }
  /** The manifest at this address, and each newer one. */
  | { readonly type: "manifests"; readonly id: number; readonly url: string; readonly name: string }
  /** A page of the manifest at this address. */
  | { readonly type: "page"; readonly id: number; readonly url: string; readonly entry: PageEntry }
  /** Bytes from `start` to before `end`; with `wholeIfNeeded` the whole file if the server does not support ranges. */
  | {
      readonly type: "read";
      readonly id: number;
      readonly start: number;
      readonly end: number;
      readonly wholeIfNeeded: boolean;
      /** A file next to the manifest `url`, instead of the opened source. */
      readonly of?: StoredPlace | undefined;
    }
  /** All bytes from `start` on, and those that are appended to the file. */
  | { readonly type: "follow"; readonly id: number; readonly start: number }
  | { readonly type: "cancel"; readonly id: number };

/** A file next to a manifest; a `small` one is passed on after it was compared with its stated size and hash. */
export interface StoredPlace {
  readonly url: string;
  readonly entry: FileEntry;
  readonly small: boolean;
}

/** Answers of the fetch worker. */
export type ReadReply =
  | {
      readonly type: "begin";
      readonly id: number;
      readonly fileBytes: number | undefined;
      readonly ranged: boolean;
    }
  | { readonly type: "bytes"; readonly id: number; readonly bytes: Uint8Array }
  | { readonly type: "end"; readonly id: number }
  /** Nothing new, or no connection; seconds until the next request. */
  | { readonly type: "waiting"; readonly id: number; readonly seconds: number; readonly problem: string | undefined }
  | { readonly type: "manifest"; readonly id: number; readonly manifest: Manifest }
  | { readonly type: "qualities"; readonly id: number; readonly qualities: readonly Quality[] }
  | { readonly type: "page"; readonly id: number; readonly content: PageContent }
  /** The connection works again. */
  | { readonly type: "recovered"; readonly id: number }
  /** A `temporary` failure may disappear without action. */
  | { readonly type: "failed"; readonly id: number; readonly message: string; readonly temporary: boolean };
