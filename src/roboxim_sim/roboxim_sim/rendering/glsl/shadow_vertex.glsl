#include "poses"
uniform mat4 clip_from_world;
in vec3 in_position;
in uvec2 in_ids;
void main() { gl_Position = clip_from_world * vec4(to_world(in_ids.x, vec4(in_position, 1.0)), 1.0); }
