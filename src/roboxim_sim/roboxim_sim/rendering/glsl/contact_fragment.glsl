in float height;
out vec2 out_taken;
void main() {
    float h = clamp(height, 0.0, 1.0);
    out_taken = vec2(1.0 - h, h);
}
