// Projects one Gaussian to its footprint on a pinhole image: docs/rendering.md, sections 1 to 3 and 5, in float32.
// Image-plane units: x right, y down, pixel coordinates divided by the focal length, z = 1.

uniform mat3 world_to_camera;
uniform vec3 position;           // camera centre, in the moved frame of the means
uniform float near;              // smallest radial distance, metres
uniform float filter_variance;   // e^2 of section 2
uniform vec2 half_size;          // half the image; of one off the optical axis, half the smallest one around both
uniform float margin;            // added to the quad, for the rounding of the rasteriser
uniform vec3 shift;              // of the camera during the exposure, its axes, metres; zero at rest

struct Gaussian {
    vec3 mean;
    float opacity;
    vec4 quat;                   // wxyz, any length
    vec3 scale;
};

// A projected Gaussian. The rows a, b, l give its response on a ray d, with D = d.xy - base:
//   Q = (a.x + a.yz . D)^2 + (b.x + b.yz . D)^2,   L = l.x + l.yz . D,   q = Q / (L^2 + thickness Q).
struct Footprint {
    vec2 center, half_axis_1, half_axis_2; // the quad: center +- half_axis_1 +- half_axis_2
    vec2 base;
    vec3 a, b, l;
    float thickness;
    float peak;                  // opacity after the low-pass filter
    float distance;              // radial distance of the mean, metres
};

mat3 rotation_from_quat(vec4 quat) {
    float norm = length(quat);
    vec4 q = norm > 0.0 ? quat / norm : vec4(1.0, 0.0, 0.0, 0.0);
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// How a Gaussian in the unit direction n moves across the ray during the exposure, camera axes, radians, as a standard
// deviation m: its covariance grows by m m', that of a line.
vec3 find_motion(vec3 n, float radius) {
    return (dot(n, shift) * n - shift) / (EXPOSURE_WAY * radius);
}

// Sets the quad to the half axes of the ellipse x' E^-1 x = 1, E = [xx xy; xy yy], lengthened by the margin.
void set_quad(inout Footprint f, float xx, float xy, float yy) {
    float mean = 0.5 * (xx + yy), half_gap = 0.5 * (xx - yy);
    float gap = length(vec2(half_gap, xy));
    // Eigenvector of the larger eigenvalue, from the better conditioned of the two rows.
    vec2 direction = half_gap >= 0.0 ? vec2(half_gap + gap, xy) : vec2(xy, gap - half_gap);
    float norm = length(direction);
    direction = norm > 0.0 ? direction / norm : vec2(1.0, 0.0);
    f.half_axis_1 = direction * (sqrt(max(mean + gap, 0.0)) + margin);
    f.half_axis_2 = vec2(-direction.y, direction.x) * (sqrt(max(mean - gap, 0.0)) + margin);
}

// The range of one coordinate of an ellipsoid that crosses the plane z = 0, within -limit to limit. The planes x = c z
// touch its cone where d_xx - 2 c d_xz + c^2 d_zz = 0; in front of the camera the cone is on one side of one of them. `n`:
// x and z of the direction of the mean.
vec2 find_range(float d_xx, float d_xz, float d_zz, vec2 n, float limit) {
    float square = d_xz * d_xz - d_xx * d_zz;
    if (!(square > 0.0) || d_zz > -1e-5) return vec2(-limit, limit);
    float root = sqrt(square), q = d_xz + (d_xz < 0.0 ? -root : root);
    vec2 c = d_xz < 0.0 ? vec2(d_xx / q, q / d_zz) : vec2(q / d_zz, d_xx / q);  // (d_xz +- root) / d_zz, the smaller first
    // A plane p = (1, 0, -c) touches at D p, which is on the mean's side of the camera if p . n > 0, and at -D p otherwise.
    // The z of D p is -root for the first plane and root for the other one.
    vec2 z = vec2(-root, root) * (n.x - c * n.y);
    float slack = 1e-3 * limit;
    if (z.y > 0.0 && z.x < 0.0) return vec2(clamp(c.y - slack, -limit, limit), limit);
    if (z.x > 0.0 && z.y < 0.0) return vec2(-limit, clamp(c.x + slack, -limit, limit));
    return vec2(-limit, limit);
}

// Sets the rows of the exact response, and the quad. `axes`: the half axes in camera axes, divided by the distance;
// `u v`: the tangent frame at the unit direction n; `m`: the motion; `b2`: the filtered block (B_uu, B_uv, B_vv).
bool set_footprint_ray(
    inout Footprint f, mat3 axes, vec3 n, vec3 u, vec3 v, vec3 m, vec3 b2, float determinant, vec2 c) {
    float root_u = sqrt(b2.x), root_v = sqrt(determinant / b2.x);
    float shear = b2.y / b2.x;
    vec3 a = u / root_u;
    vec3 b = (v - shear * u) / root_v;
    vec2 solved = vec2(c.x / root_u, (c.y - shear * c.x) / root_v);
    vec3 l = n - solved.x * a - solved.y * b;

    bool centred = n.z > 0.05;
    f.base = centred ? n.xy / n.z : vec2(0.0);
    f.a = vec3(centred ? 0.0 : a.z, a.xy);
    f.b = vec3(centred ? 0.0 : b.z, b.xy);
    f.l = vec3(centred ? 1.0 / n.z : l.z, l.xy);

    // Dual cone D = n n' - kappa C' (section 5). Its section by the image plane is an ellipse with centre
    // (D_xz, D_yz) / D_zz and shape matrix (D_z D_z' - D_zz D_xy) / D_zz^2. The expansion around n cancels the large
    // terms symbolically instead of in float32.
    float kappa = 2.0 * log(f.peak / ALPHA_CUT);
    vec3 x = vec3(axes[0].x, axes[1].x, axes[2].x);
    vec3 y = vec3(axes[0].y, axes[1].y, axes[2].y);
    vec3 z = vec3(axes[0].z, axes[1].z, axes[2].z);
    float e2 = filter_variance;
    float c_xx = dot(x, x) + e2 * (1.0 - n.x * n.x) + m.x * m.x, c_xy = dot(x, y) - e2 * n.x * n.y + m.x * m.y;
    float c_yy = dot(y, y) + e2 * (1.0 - n.y * n.y) + m.y * m.y, c_yz = dot(y, z) - e2 * n.y * n.z + m.y * m.z;
    float c_zz = dot(z, z) + e2 * (1.0 - n.z * n.z) + m.z * m.z, c_xz = dot(x, z) - e2 * n.x * n.z + m.x * m.z;
    float d_zz = n.z * n.z - kappa * c_zz;
    if (d_zz < 1e-3) {
        // The ellipsoid crosses the plane z = 0, or all of it is behind the camera.
        if (n.z < 0.0 && d_zz > 1e-5) return false;
        vec2 x_range = find_range(n.x * n.x - kappa * c_xx, n.x * n.z - kappa * c_xz, d_zz, n.xz, half_size.x + margin);
        vec2 y_range = find_range(n.y * n.y - kappa * c_yy, n.y * n.z - kappa * c_yz, d_zz, n.yz, half_size.y + margin);
        f.center = 0.5 * vec2(x_range.x + x_range.y, y_range.x + y_range.y);
        f.half_axis_1 = vec2(0.5 * max(x_range.y - x_range.x, 0.0), 0.0);
        f.half_axis_2 = vec2(0.0, 0.5 * max(y_range.y - y_range.x, 0.0));
        return true;
    }
    if (n.z < 0.0) return false;
    vec3 h_x = n.z * x - n.x * z, h_y = n.z * y - n.y * z;
    vec2 h_m = n.z * m.xy - m.z * n.xy;
    float e_xx = dot(h_x, h_x) + h_m.x * h_m.x + e2 * (n.z * n.z + n.x * n.x) + kappa * (c_xz * c_xz - c_xx * c_zz);
    float e_yy = dot(h_y, h_y) + h_m.y * h_m.y + e2 * (n.z * n.z + n.y * n.y) + kappa * (c_yz * c_yz - c_yy * c_zz);
    float e_xy = dot(h_x, h_y) + h_m.x * h_m.y + e2 * n.x * n.y + kappa * (c_xz * c_yz - c_xy * c_zz);
    float scale = kappa / (d_zz * d_zz);
    f.center = (n.xy * n.z - kappa * vec2(c_xz, c_yz)) / d_zz;
    set_quad(f, scale * e_xx, scale * e_xy, scale * e_yy);
    return true;
}

// Returns whether the Gaussian can be visible.
bool project_gaussian(Gaussian gaussian, out Footprint f) {
    vec3 offset = gaussian.mean - position;
    f.distance = length(offset);
    if (!(f.distance >= near && f.distance > 0.0)) return false;
    vec3 n = world_to_camera * (offset / f.distance);
    vec3 k = gaussian.scale / f.distance;
    mat3 unit = world_to_camera * rotation_from_quat(gaussian.quat);
    mat3 axes = mat3(unit[0] * k.x, unit[1] * k.y, unit[2] * k.z);

    vec3 u = normalize(abs(n.z) < 0.7 ? vec3(n.y, -n.x, 0.0) : vec3(0.0, n.z, -n.y));
    vec3 v = cross(n, u);
    vec3 u_a = u * axes, v_a = v * axes, n_a = n * axes;
    vec3 w = k.yzx * k.zxy, w2 = w * w;
    vec3 u_e = u * unit, v_e = v * unit, n_e = n * unit;
    float e2 = filter_variance;
    float trace = dot(u_a, u_a) + dot(v_a, v_a);
    float sharp = dot(w2, n_e * n_e);
    vec3 m = find_motion(n, f.distance), across = cross(n, m) * axes, m_e = m * unit;
    float determinant = sharp + e2 * trace + e2 * e2 + dot(across, across) + e2 * dot(m, m);
    f.peak = gaussian.opacity * sqrt(sharp / determinant);  // the filter and the motion conserve energy
    if (!(f.peak >= ALPHA_CUT)) return false;

    float volume = k.x * k.y * k.z;
    float along = e2 * e2 * dot(n_a, n_a) + e2 * dot(w2, u_e * u_e + v_e * v_e) + volume * volume;
    along += dot(w2, m_e * m_e) + e2 * dot(m, m) * dot(n_a, n_a);
    f.thickness = along / determinant;
    vec2 m_a = vec2(dot(u, m), dot(v, m));
    vec3 b2 = vec3(dot(u_a, u_a) + e2, dot(u_a, v_a), dot(v_a, v_a) + e2) + m_a.xxy * m_a.xyy;
    return set_footprint_ray(f, axes, n, u, v, m, b2, determinant, vec2(dot(u_a, n_a), dot(v_a, n_a)));
}
