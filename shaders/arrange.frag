// The images of both eyes in one image.
uniform sampler2D left;
uniform sampler2D right;
uniform int arrangement;    // 0 next to each other, 1 left above right, 2 anaglyph

layout(location = 0) out vec4 out_color;

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy), size = textureSize(left, 0);
    if (arrangement == 0) {
        bool is_left = pixel.x < size.x;
        out_color = is_left ? texelFetch(left, pixel, 0) : texelFetch(right, pixel - ivec2(size.x, 0), 0);
    } else if (arrangement == 1) {
        bool is_left = pixel.y >= size.y;
        out_color = is_left ? texelFetch(left, pixel - ivec2(0, size.y), 0) : texelFetch(right, pixel, 0);
    } else {
        vec4 first = texelFetch(left, pixel, 0), second = texelFetch(right, pixel, 0);
        out_color = vec4(first.r, second.gb, max(first.a, second.a));
    }
}
