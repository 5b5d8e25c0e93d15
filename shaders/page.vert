// One corner of a Gaussian's quad, from the data textures. An instance draws a batch of quads: instances of one quad each
// are slow on many devices.
#include "splat.glsl"

uniform sampler2D geometry;     // three texels a Gaussian: mean and opacity; quaternion; scales
uniform sampler2D colors;
uniform usampler2D order;       // indices of the Gaussians, view by view, farthest first
uniform ivec2 segment;          // of the order: first place and count
uniform vec2 color_range;       // the colours of the bytes 0 and 255
uniform vec3 sides[4];          // inward unit normals of the view frustum, camera axes
uniform vec4 window;            // centre and half the size of the image, image plane

flat out vec2 v_base;
flat out vec4 v_a;
flat out vec4 v_b;
flat out vec4 v_l;
flat out vec3 v_color;

// Whether a ball around the Gaussian's visible part is on the outer side of one of the frustum's sides. This rejects
// most Gaussians before the projection.
bool is_ball_outside(vec3 mean, float opacity, vec3 scale) {
    vec3 offset = mean - position;
    vec3 center = world_to_camera * offset;
    float reach = sqrt(2.0 * log(max(opacity / ALPHA_CUT, 1.0)));
    float largest = max(scale.x, max(scale.y, scale.z));
    float radius = 1.001 * reach * (largest + sqrt(filter_variance) * length(offset)) + 1e-5 * length(offset);
    for (int i = 0; i < 4; i++) {
        if (dot(sides[i], center) < -radius) return true;
    }
    return false;
}

// Whether the visible cone of the Gaussian is on the outer side of one of the frustum's sides: docs/rendering.md,
// section 5. The quad of a Gaussian that crosses the camera's plane covers the whole image, so this test matters.
bool is_cone_outside(Gaussian gaussian, Footprint f) {
    vec3 n = world_to_camera * ((gaussian.mean - position) / f.distance);
    mat3 unit = world_to_camera * rotation_from_quat(gaussian.quat);
    vec3 k = gaussian.scale / f.distance;
    float kappa = 2.0 * log(f.peak / ALPHA_CUT) + 1e-3;
    for (int i = 0; i < 4; i++) {
        float height = dot(sides[i], n);
        vec3 across = (sides[i] * unit) * k;
        float variance = dot(across, across) + filter_variance * (1.0 - height * height);
        if (height < 0.0 && height * height > kappa * variance) return true;
    }
    return false;
}

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside the image
    v_base = vec2(0.0);
    v_a = v_b = v_l = vec4(0.0);
    v_color = vec3(0.0);
    int place = gl_InstanceID * BATCH + (gl_VertexID >> 2);
    if (place >= segment.y) return;
    place += segment.x;
    int width = textureSize(colors, 0).x;
    int index = int(texelFetch(order, ivec2(place % width, place / width), 0).r);
    ivec2 texel = ivec2(index % width, index / width);
    ivec2 first = ivec2(3 * texel.x, texel.y);
    vec4 mean_opacity = texelFetch(geometry, first, 0);
    vec3 scale = texelFetch(geometry, first + ivec2(2, 0), 0).xyz;
    if (is_ball_outside(mean_opacity.xyz, mean_opacity.w, scale)) return;
    vec4 quat = texelFetch(geometry, first + ivec2(1, 0), 0);
    Gaussian gaussian = Gaussian(mean_opacity.xyz, mean_opacity.w, quat, scale);
    Footprint f;
    if (!project_gaussian(gaussian, f) || is_cone_outside(gaussian, f)) return;
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0;
    vec2 screen = (f.center + corner.x * f.half_axis_1 + corner.y * f.half_axis_2 - window.xy) / window.zw;
    gl_Position = vec4(screen.x, -screen.y, 0.0, 1.0);
    v_base = f.base;
    v_a = vec4(f.a, f.thickness);
    v_b = vec4(f.b, f.distance);
    v_l = vec4(f.l, f.peak);
    v_color = mix(color_range.xxx, color_range.yyy, texelFetch(colors, texel, 0).rgb);
}
