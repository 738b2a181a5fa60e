// Height map of the objects above the table's top: the space between an object's lowest and highest point is occupied.
// Heights are divided by CONTACT_REACH and blended by maximum; the lower height is stored as 1 - h, so that empty space
// is (0, 0).
#include "poses"
uniform vec4 contact_box;                 // xy: lower corner, z: 1 / extent, w: height of the table's top
in vec3 in_position;
in uvec2 in_ids;
out float height;
void main() {
    vec3 p = to_world(in_ids.x, vec4(in_position, 1.0));
    height = (p.z - contact_box.w) / CONTACT_REACH;
    gl_Position = vec4((p.xy - contact_box.xy) * contact_box.z * 2.0 - 1.0, 0.0, 1.0);
}
