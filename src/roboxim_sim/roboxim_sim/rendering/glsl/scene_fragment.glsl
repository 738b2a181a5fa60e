// Optimised for software GL (llvmpipe), where every instruction of the fragment shader counts:
// - no pow, exp or trigonometry per pixel;
// - an analytic studio (sky, ground, two soft boxes) instead of an environment map;
// - one pass that writes colour, depth and segmentation.
#include "view"
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
    if (p.w <= 0.0) return 1.0;           // behind the lamp as it looks at the casters
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
