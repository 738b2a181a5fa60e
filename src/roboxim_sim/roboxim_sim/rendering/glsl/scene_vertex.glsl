#include "poses"
#include "view"
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;
in vec4 in_color;
in vec4 in_surface;
in uvec2 in_ids;
out vec3 position;
out vec3 normal;
#ifdef TEXTURE
out vec2 uv;
#endif
flat out vec4 color;
flat out vec3 surface;
out float openness;
void main() {
    position = to_world(in_ids.x, vec4(in_position, 1.0));
    normal = to_world(in_ids.x, vec4(in_normal, 0.0));
#ifdef TEXTURE
    uv = in_uv;
#endif
    color = in_color;
    // Darken surfaces that face the nearby table, because the table is shaded there.
    float near = clamp(1.0 - 12.0 * abs(position.z - slab.z), 0.0, 1.0);
    openness = in_surface.z * (1.0 - 0.55 * slab.w * near * clamp(-normal.z, 0.0, 1.0));
    surface = vec3(in_surface.x, floor(in_surface.y * 255.0 - 0.5), float(in_ids.y));    // texture 1 is layer 0
    gl_Position = clip_from_world * vec4(position, 1.0);
}
