// A photograph over the picture: cube maps of two sizes, of which the larger one is transparent where it has not arrived.
uniform highp samplerCube preview;
uniform highp samplerCube detail;
uniform vec4 window;            // centre and half the size of the image, image plane
uniform vec2 origin;            // lower left corner of the image, pixels
uniform vec2 size;              // of it, pixels
uniform vec3 beside;            // from the panorama to the camera, over the distance of surfaces; camera axes
uniform mat3 camera_to_cube;    // rotation, OpenCV axes to those of OpenGL's cube maps
uniform float opacity;

out vec4 color;

vec3 sample_photograph(vec2 place) {
    vec2 plane = window.xy + (2.0 * (place - origin) / size - 1.0) * vec2(1.0, -1.0) * window.zw;
    vec3 direction = camera_to_cube * (normalize(vec3(plane, 1.0)) + beside);
    vec4 near = texture(detail, direction, -1.0);  // a sample is of a quarter of a pixel
    return near.a < 1.0 ? near.rgb + (1.0 - near.a) * texture(preview, direction, -1.0).rgb : near.rgb;
}

void main() {
    vec3 sum = vec3(0.0);
    for (int k = 0; k < 4; k++) sum += sample_photograph(gl_FragCoord.xy + 0.5 * vec2(k & 1, k >> 1) - 0.25);
    color = vec4(0.25 * opacity * sum, opacity);
}
