uniform vec3 color;
layout(location = 0) out vec4 out_color;
#ifdef GEOMETRY
layout(location = 1) out vec2 out_geometry;
#endif
void main() {
    out_color = vec4(color, dot(color, vec3(0.299, 0.587, 0.114)));
#ifdef GEOMETRY
    out_geometry = vec2(uintBitsToFloat(0x7f800000u), 0.0);   // infinitely far
#endif
}
