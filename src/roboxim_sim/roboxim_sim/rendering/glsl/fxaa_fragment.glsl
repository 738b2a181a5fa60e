// Fast approximate anti-aliasing (FXAA) on the luma in alpha. Edges are smoothed along their direction. A pixel that
// differs from all its neighbours has no edge direction (a seam thinner than a pixel is a row of dots): it is blended
// with its neighbourhood.
uniform sampler2D image;
out vec4 out_color;
vec4 texel(ivec2 p) { return texelFetch(image, clamp(p, ivec2(0), textureSize(image, 0) - 1), 0); }
vec3 smooth_at(vec2 p) { return texture(image, p / vec2(textureSize(image, 0))).rgb; }
void main() {
    ivec2 p = ivec2(gl_FragCoord.xy);
    vec4 m = texelFetch(image, p, 0);
    vec4 a = texel(p + ivec2(-1, -1)), b = texel(p + ivec2(1, -1));
    vec4 c = texel(p + ivec2(-1, 1)), d = texel(p + ivec2(1, 1));
    vec4 n = texel(p + ivec2(0, -1)), e = texel(p + ivec2(1, 0));
    vec4 s = texel(p + ivec2(0, 1)), w = texel(p + ivec2(-1, 0));
    vec4 sides = n + e + s + w, corners = a + b + c + d;
    float low = min(m.a, min(min(min(a.a, b.a), min(c.a, d.a)), min(min(n.a, s.a), min(e.a, w.a))));
    float high = max(m.a, max(max(max(a.a, b.a), max(c.a, d.a)), max(max(n.a, s.a), max(e.a, w.a))));
    if (high - low <= max(0.03, high * 0.08)) discard;      // the target holds the colour already
    vec2 along = vec2((c.a + d.a) - (a.a + b.a), (a.a + c.a) - (b.a + d.a));
    float damp = max(corners.a * 0.03125, 0.0078125);
    along = clamp(along / (min(abs(along.x), abs(along.y)) + damp), -8.0, 8.0);
    vec2 at = gl_FragCoord.xy;
    vec3 near = 0.5 * (smooth_at(at - along / 6.0) + smooth_at(at + along / 6.0));
    vec3 wide = 0.5 * near + 0.25 * (smooth_at(at - along * 0.5) + smooth_at(at + along * 0.5));
    float wide_luma = dot(wide, vec3(0.299, 0.587, 0.114));
    vec3 blend = (wide_luma < low || wide_luma > high) ? near : wide;
    float alone = abs((2.0 * sides.a + corners.a) / 12.0 - m.a) / (high - low);
    vec3 around = (4.0 * m + 2.0 * sides + corners).rgb / 16.0;
    out_color = vec4(mix(blend, around, smoothstep(0.05, 0.75, alone)), 1.0);
}
