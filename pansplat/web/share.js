// Links to a pose, and pictures. A pose has `position` (three numbers in the page's unit), `yaw`, `pitch` and `fov` (degrees); it
// stands in the hash of the address as #at=x,y,z,yaw,pitch,fov.

import { explain, say } from "./dom.js";
import { DEGREE, wrapAngle } from "./graph.js";
import { takePicture } from "./picture.js";
import { camera } from "./state.js";

export function poseOf({ position, yaw, pitch, fov }) {
  return { position: [...position], yaw: wrapAngle(yaw) / DEGREE, pitch: pitch / DEGREE, fov };
}

function formatPose(pose) {
  return `#at=${[...pose.position, pose.yaw, pose.pitch, pose.fov].map((value) => Number(value.toFixed(3))).join()}`;
}

// Returns null if the hash has no pose.
export function parsePose(hash) {
  const found = /^#at=([-+.\de]+(?:,[-+.\de]+){5})$/i.exec(hash), values = found ? found[1].split(",").map(Number) : [];
  if (values.length !== 6 || !values.every(Number.isFinite)) return null;
  const [x, y, z, yaw, pitch, fov] = values;
  return { position: [x, y, z], yaw, pitch, fov };
}

// Where the browser does not allow the clipboard, the link is shown.
export async function copyLink() {
  const link = location.href.split("#")[0] + formatPose(poseOf(camera));
  try {
    await navigator.clipboard.writeText(link);
    say("Link to this view copied");
  } catch {
    explain(link);
  }
}

// Downloads the picture of the camera at the full resolution.
export async function savePicture() {
  const blob = await takePicture(), link = document.createElement("a");
  if (!blob) return;
  link.href = URL.createObjectURL(blob);
  link.download = `${document.title}.png`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  say(window.parent === window ? "Picture saved" : "Picture saved, if the page around this frame allows downloads");
}
