// The images of both eyes in one image.
uniform sampler2D left;
uniform sampler2D right;
uniform bool is_stacked;    // the left above the right, else next to each other

layout(location = 0) out vec4 out_color;

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy), size = textureSize(left, 0);
    ivec2 offset = is_stacked ? ivec2(0, size.y) : ivec2(size.x, 0);
    bool is_second = is_stacked ? pixel.y >= size.y : pixel.x >= size.x;
    ivec2 place = is_second ? pixel - offset : pixel;
    out_color = is_second == is_stacked ? texelFetch(left, place, 0) : texelFetch(right, place, 0);
}
