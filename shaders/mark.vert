// A parallelogram in the scene, seen by a camera of page.vert: marks on the floor, rays and labels in a headset.
uniform mat3 world_to_camera;
uniform vec3 position;          // camera centre, world
uniform vec4 window;            // centre and half the size of the image, image plane
uniform vec3 center;            // of the parallelogram, world
uniform vec3 axis_1, axis_2;    // from its centre to its sides

out vec2 uv;                    // -1 to 1 along the axes

void main() {
    uv = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    vec3 point = world_to_camera * (center + uv.x * axis_1 + uv.y * axis_2 - position);
    vec2 screen = (point.xy - window.xy * point.z) / window.zw;
    gl_Position = vec4(screen.x, -screen.y, 0.0, point.z);
}
