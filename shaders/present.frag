// The rendered image on the screen, or a photograph in the directions of the camera.
uniform sampler2D image;            // bottom row first
uniform sampler2D fading;           // the image of another scene, bottom row first
uniform float weight;               // of `image` against `fading`
uniform sampler2D photograph;       // equirectangular, top row first
uniform bool shows_photograph;
uniform vec2 tangent;               // of half the horizontal and vertical field of view
uniform mat3 camera_to_photo;       // rotation, OpenCV axes
uniform vec3 beside;                // from the photograph's camera, over the distance of surfaces; its axes

in vec2 uv;

out vec4 color;

const float PI = 3.14159265358979;

vec3 sample_image() {
    vec3 rgb = texture(image, uv).rgb;
    return weight < 1.0 ? mix(texture(fading, uv).rgb, rgb, weight) : rgb;
}

vec3 sample_photograph() {
    vec2 ray = (2.0 * uv - 1.0) * tangent;
    vec3 d = camera_to_photo * normalize(vec3(ray.x, -ray.y, 1.0)) + beside;
    vec2 photo_uv = vec2(atan(d.x, d.z) / (2.0 * PI) + 0.5, atan(d.y, length(d.xz)) / PI + 0.5);
    return textureLod(photograph, photo_uv, 0.0).rgb;  // level 0: derivatives have a seam at +-180 degrees
}

void main() {
    color = vec4(shows_photograph ? sample_photograph() : sample_image(), 1.0);
}
