// Alpha of one footprint at one pixel: docs/rendering.md, sections 3 and 4.
uniform vec2 focal;         // pixels; those of a headset may not be square
uniform vec2 principal;     // window coordinates of the optical axis
flat in vec2 v_base;
flat in vec4 v_a;           // a, thickness
flat in vec4 v_b;           // b, distance
flat in vec4 v_l;           // l, peak
flat in vec3 v_color;

layout(location = 0) out vec4 out_color;    // premultiplied
layout(location = 1) out vec4 out_depth;    // alpha x radial distance

void main() {
    vec2 ray = (gl_FragCoord.xy - principal) / focal;
    vec2 delta = vec2(ray.x, -ray.y) - v_base;
    float p = v_a.x + dot(v_a.yz, delta);
    float r = v_b.x + dot(v_b.yz, delta);
    float q = p * p + r * r;
    float front = v_l.x + dot(v_l.yz, delta);
    float response = q / (front * front + v_a.w * q);
    float alpha = min(MAX_ALPHA, v_l.w * exp(-0.5 * response));
    if (!(front > 0.0) || !(alpha >= ALPHA_CUT)) discard;
    out_color = vec4(v_color * alpha, alpha);
    out_depth = vec4(v_b.w * alpha, 0.0, 0.0, alpha);
}
