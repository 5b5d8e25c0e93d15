// A corner of a triangle of the doll's house, seen by a camera of page.vert.
uniform mat3 world_to_camera;
uniform vec3 position;          // camera centre, world
uniform vec4 window;            // centre and half the size of the image, image plane
uniform mat3 level;             // axes of a level camera

layout(location = 0) in vec3 place;  // world
layout(location = 1) in vec2 uv;     // in the atlas; of the top of a wall, the wall's normal (right, forward) + 2

out vec2 v_uv;

void main() {
    vec3 point = world_to_camera * (place - position), normal = level * vec3(uv.x - 2.0, 0.0, uv.y - 2.0);
    vec2 screen = (point.xy - window.xy * point.z) / window.zw;
    gl_Position = vec4(screen.x, -screen.y, point.z - 0.1, point.z);  // nearer than 0.05 nothing is drawn
    v_uv = uv;
    if (max(uv.x, uv.y) > 1.0 && dot(normal, place - position) > 0.0) gl_Position.w = -1.0;  // the wall shows its back
}
