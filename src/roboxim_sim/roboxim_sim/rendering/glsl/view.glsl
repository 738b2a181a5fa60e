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
