"""GLSL of the `raster` renderer.

Optimised for software GL (llvmpipe), where every instruction of the fragment shader counts:

- no ``pow``, ``exp`` or trigonometry per pixel;
- an analytic studio (sky, ground, two soft boxes) instead of an environment map;
- one pass that writes colour, depth and segmentation.
"""

_POSES = """
layout(std140) uniform Poses { vec4 rows[3 * MAX_BODIES]; };
vec3 to_world(uint body, vec4 p) {
    int i = int(body) * 3;
    return vec3(dot(rows[i], p), dot(rows[i + 1], p), dot(rows[i + 2], p));
}
"""

_VIEW = """
layout(std140) uniform View {
    mat4 clip_from_world;
    mat4 light_from_world;               // to the shadow map's coordinates
    vec4 eye;                            // w: offset along a caster's normal for reading the shadow map [m]
    vec4 sky;                            // w: number of further lights
    vec4 ground;                         // w: texels of the shadow map
    vec4 main_vector;                    // xyz: towards a sun, or a lamp's position; w: 0 sun, else lamp's range^2
    vec4 main_color;                     // irradiance / pi
    vec4 contact_box;                    // xy: lower corner, z: 1 / extent
    vec4 slab;                           // table's top: xyz centre, w: 1
    vec4 slab_half;                      // xy: half its extent, z: width of its shadow's edge over the height
    vec4 more_vectors[MAX_LIGHTS - 1];
    vec4 more_colors[MAX_LIGHTS - 1];
};
"""

SHADOW_VERTEX = (
    _POSES
    + """
uniform mat4 clip_from_world;
in vec3 in_position;
in uvec2 in_ids;
void main() { gl_Position = clip_from_world * vec4(to_world(in_ids.x, vec4(in_position, 1.0)), 1.0); }
"""
)

SHADOW_FRAGMENT = """
void main() {}
"""

# A body seen from many sides, one instance for each side, in adjacent cells.
OCCLUSION_VERTEX = """
uniform mat3 axes[SIDES];
in vec3 in_position;
void main() {
    vec3 p = axes[gl_InstanceID] * in_position;          // within the unit ball
    vec2 cell = vec2(gl_InstanceID % COLUMNS, gl_InstanceID / COLUMNS);
    gl_Position = vec4((p.xy + 1.0 + 2.0 * cell) / vec2(COLUMNS, ROWS) - 1.0, p.z, 1.0);
}
"""

SCENE_VERTEX = (
    _POSES
    + _VIEW
    + """
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
"""
)

SCENE_FRAGMENT = (
    _VIEW
    + """
uniform sampler2DShadow shadow_map;
uniform sampler2D contact_map;            // fraction of the surroundings that objects above the table occlude
uniform sampler2DArray textures;
in vec3 position;
in vec3 normal;
#ifdef TEXTURE
in vec2 uv;
#endif
flat in vec4 color;
flat in vec3 surface;
in float openness;
layout(location = 0) out vec4 out_color;
#ifdef GEOMETRY
layout(location = 1) out vec2 out_geometry;
#endif

// 3x3 texel tent filter with four bilinear comparisons (Castano, "Shadow mapping summary"): smooth at any scale.
float sunlit() {
    float shadow_size = ground.w;
#ifdef CONTACT                             // the table's top is not in the shadow map: no offset needed
    vec4 p = light_from_world * vec4(position, 1.0);
#else
    vec4 p = light_from_world * vec4(position + normal * eye.w, 1.0);
#endif
#ifdef LAMP
    p.xyz /= p.w;
#endif
    vec2 at = p.xy * shadow_size + 0.5;
    vec2 corner = floor(at);
    vec2 s = at - corner;
    vec2 w0 = 3.0 - 2.0 * s, w1 = 1.0 + 2.0 * s;
    vec2 p0 = (corner - 1.5 + (2.0 - s) / w0) / shadow_size, p1 = (corner + 0.5 + s / w1) / shadow_size;
    return (w0.x * w0.y * texture(shadow_map, vec3(p0, p.z)) + w1.x * w0.y * texture(shadow_map, vec3(p1.x, p0.y, p.z))
          + w0.x * w1.y * texture(shadow_map, vec3(p0.x, p1.y, p.z)) + w1.x * w1.y * texture(shadow_map, vec3(p1, p.z)))
        / 16.0;
}

// The rectangular shadow of the table on surfaces below it.
float beside_slab() {
#ifdef LAMP
    vec3 l = main_vector.xyz - position;
#else
    vec3 l = main_vector.xyz;
#endif
    float above = slab.z - position.z;
    float t = above / max(l.z, 1e-3);
    vec2 out_of = abs(position.xy + t * l.xy - slab.xy) - slab_half.xy;
    vec2 cover = clamp(0.5 - out_of / (slab_half.z * max(above, 1e-3)), 0.0, 1.0);
    return 1.0 - cover.x * cover.y * float(above > 0.0);
}

struct Surface { vec3 n, v, diffuse, f0; float nv, a, a2; };

vec3 reflected(Surface s, vec4 light, vec3 radiance) {
    vec3 to_light = light.xyz - position * float(light.w > 0.0);
    float d2 = dot(to_light, to_light);
    vec3 l = to_light * inversesqrt(d2);
    vec3 h = normalize(l + s.v);
    float nl = clamp(dot(s.n, l), 0.0, 1.0);
    float nh = clamp(dot(s.n, h), 0.0, 1.0);
    float f = 1.0 - clamp(dot(l, h), 0.0, 1.0);
    float f2 = f * f;
    float d = nh * nh * (s.a2 - 1.0) + 1.0;
    float gloss = min(s.a2 * 0.5 / (d * d * mix(2.0 * nl * s.nv, nl + s.nv, s.a) + 1e-4), 8.0);
    vec3 fresnel = s.f0 + (1.0 - s.f0) * (f2 * f2 * f);
    float strength = light.w > 0.0 ? light.w / max(d2, 0.01) : 1.0;
    return (nl * strength) * radiance * (s.diffuse + fresnel * gloss);
}

void main() {
#ifdef COLOURLESS
    out_color = vec4(0.0);
#else
    vec3 n = normalize(normal);
    vec3 v = normalize(eye.xyz - position);
    vec3 base = color.rgb;
#ifdef TEXTURE
    base *= texture(textures, vec3(uv, surface.y)).rgb;
#endif
    base *= base;                          // stored as square roots of linear values
    float metallic = color.a;
    float roughness = surface.x;
    vec3 f0 = mix(vec3(0.04), base, metallic);
    vec3 diffuse = base * (1.0 - metallic);
    float a = roughness * roughness;
    float nv = clamp(dot(n, v), 0.02, 1.0);
    Surface s = Surface(n, v, diffuse, f0, nv, a, a * a);
    float reaches = 1.0;
#ifdef SHADOW
    reaches = sunlit();
#endif
#ifdef OVERHANG
    reaches *= beside_slab();
#endif
    vec3 lit = reflected(s, main_vector, main_color.rgb * reaches);
#ifdef MORE_LIGHTS                         // even a loop with zero iterations costs a fifth of the frame
    for (int i = 0; i < int(sky.w); i++) lit += reflected(s, more_vectors[i], more_colors[i].rgb);
#endif

    float open = openness;
#ifdef CONTACT
    open -= texture(contact_map, (position.xy - contact_box.xy) * contact_box.z).x * clamp(n.z, 0.0, 1.0);
#endif

    vec3 r = 2.0 * dot(n, v) * n - v;
    float spread = 3.0 + 60.0 * (1.0 - roughness) * (1.0 - roughness);
    float box_a = 1.0 / (1.0 + spread * (1.0 - dot(r, vec3(-0.48, 0.36, 0.8))));
    float box_b = 1.0 / (1.0 + spread * (1.0 - dot(r, vec3(0.3, -0.8, 0.52))));
    vec3 around = mix(ground.rgb, sky.rgb, clamp(r.z * (1.2 - 0.7 * roughness) + 0.5, 0.0, 1.0));
    around += sky.rgb * ((1.0 - roughness) * (2.2 * box_a * box_a + 1.6 * box_b * box_b));
    float g = 1.0 - nv;
    float g2 = g * g;
    float smoothness = 1.0 - roughness;
    vec3 mirror = f0 * (1.0 - 0.45 * roughness) + 0.5 * smoothness * smoothness * (g2 * g2 * g) * (1.0 - f0);
    vec3 ambient = diffuse * mix(ground.rgb, sky.rgb, n.z * 0.5 + 0.5) + around * mirror;
    vec3 c = lit + ambient * open;

    vec3 over = max(c - 0.6, 0.0);         // soft shoulder, asymptote 1
    c = min(c, 0.6) + over / (1.0 + over * 2.5);
    vec3 s1 = sqrt(c), s2 = sqrt(s1);      // linear to sRGB without pow; off by < 0.5 / 255 above the linear toe
    c = 0.585122381 * s1 + 0.783140355 * s2 - 0.368262736 * sqrt(s2);
    out_color = vec4(c, dot(c, vec3(0.299, 0.587, 0.114)));
#endif
#ifdef GEOMETRY
    out_geometry = vec2(1.0 / gl_FragCoord.w, surface.z);
#endif
}
"""
)

SCREEN_VERTEX = """
in vec2 in_corner;
void main() { gl_Position = vec4(in_corner, 1.0, 1.0); }
"""

BACKDROP_FRAGMENT = """
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
"""

# Fast approximate anti-aliasing (FXAA) on the luma in alpha. Edges are smoothed along their direction. A pixel that
# differs from all its neighbours has no edge direction (a seam thinner than a pixel is a row of dots): it is blended
# with its neighbourhood.
FXAA_FRAGMENT = """
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
"""

# Height map of the objects above the table's top: the space between an object's lowest and highest point is occupied.
# Heights are divided by CONTACT_REACH and blended by maximum; the lower height is stored as 1 - h, so that empty space
# is (0, 0).
CONTACT_VERTEX = (
    _POSES
    + """
uniform vec4 contact_box;                 // xy: lower corner, z: 1 / extent, w: height of the table's top
in vec3 in_position;
in uvec2 in_ids;
out float height;
void main() {
    vec3 p = to_world(in_ids.x, vec4(in_position, 1.0));
    height = (p.z - contact_box.w) / CONTACT_REACH;
    gl_Position = vec4((p.xy - contact_box.xy) * contact_box.z * 2.0 - 1.0, 0.0, 1.0);
}
"""
)

CONTACT_FRAGMENT = """
in float height;
out vec2 out_taken;
void main() {
    float h = clamp(height, 0.0, 1.0);
    out_taken = vec2(1.0 - h, h);
}
"""

# Fraction of the cosine-weighted surroundings that is occluded at points of the table. In each direction, columns at
# decreasing distances occlude ranges of elevation; a nearer column counts only above what farther ones occlude.
CONTACT_SHADE_FRAGMENT = """
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
"""
