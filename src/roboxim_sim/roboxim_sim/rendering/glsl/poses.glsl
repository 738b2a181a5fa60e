layout(std140) uniform Poses { vec4 rows[3 * MAX_BODIES]; };
vec3 to_world(uint body, vec4 p) {
    int i = int(body) * 3;
    return vec3(dot(rows[i], p), dot(rows[i + 1], p), dot(rows[i + 2], p));
}
