// A body seen from many sides, one instance for each side, in adjacent cells.
uniform mat3 axes[SIDES];
in vec3 in_position;
void main() {
    vec3 p = axes[gl_InstanceID] * in_position;          // within the unit ball
    vec2 cell = vec2(gl_InstanceID % COLUMNS, gl_InstanceID / COLUMNS);
    gl_Position = vec4((p.xy + 1.0 + 2.0 * cell) / vec2(COLUMNS, ROWS) - 1.0, p.z, 1.0);
}
