// Fraction of the cosine-weighted surroundings that is occluded at points of the table. In each direction, columns at
// decreasing distances occlude ranges of elevation; a nearer column counts only above what farther ones occlude.
uniform sampler2D image;
uniform float texels;                     // texels of the map per metre
out float out_hidden;
vec2 taken(vec2 offset) {                 // squared sines of the lowest and the highest elevation
    vec2 h = texture(image, (gl_FragCoord.xy + offset * texels) / vec2(textureSize(image, 0))).xy;
    h = CONTACT_REACH * vec2(1.0 - h.x, h.y);
    h *= h;
    return h / (h + dot(offset, offset));
}
void main() {
    vec2 above = taken(vec2(0.003, 0.0));
    float hidden = 0.0;
    for (int k = 0; k < 8; k++) {
        float angle = 0.7853981634 * (float(k) + 0.3);
        vec2 along = vec2(cos(angle), sin(angle));
        vec2 far = taken(0.060 * along), middle = taken(0.027 * along), near = taken(0.011 * along);
        far.y *= 0.6;
        float most = far.y;
        hidden += max(far.y - far.x, 0.0) + max(middle.y - max(middle.x, most), 0.0);
        most = max(most, middle.y);
        hidden += max(near.y - max(near.x, most), 0.0);
        most = max(most, near.y);
        hidden += max(above.y - max(above.x, most), 0.0);
    }
    float open = clamp(1.0 - 0.125 * hidden, 0.0, 1.0);
    out_hidden = 1.0 - open * sqrt(open);   // darker than ambient occlusion alone, as lamps with a size cause it
}
