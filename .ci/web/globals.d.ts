// What pansplat/export/page.py writes before the modules, and what these add to the window. header.d.ts has HEADER.

declare const SHADERS: Record<"splat" | "accumulate" | "resolve" | "mark" | "photograph" | "house", [vertex: string, fragment: string]>;
declare const WORKER: string;

interface Window {
  addChunk(view: number, isLast: boolean): void;
  addTile(name: string, number: number): void;
  pansplat: EventTarget & Record<string, any>;
}
