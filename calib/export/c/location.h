/* The place of the contact as the image tells it, m; NaN where the image is nowhere positive, or not known. */
static inline void skin_locate(skin_result *out)
{
    float top = 0.0f, total = 0.0f, x = 0.0f, y = 0.0f;
    for (uint32_t p = 0; p < SKIN_PIXELS; p++)
        top = fmaxf(top, out->image[p]);
    for (uint32_t p = 0; p < SKIN_PIXELS; p++) {
        const float value = out->image[p];
        const float weight = /*@WEIGHT@*/;
        x += weight * skin_pixel[p][0];
        y += weight * skin_pixel[p][1];
        total += weight;
    }
    out->place[0] = total > 0.0f ? x / total : NAN;
    out->place[1] = total > 0.0f ? y / total : NAN;
}

/* Square of the distance from x, y to a side; the nearest point of the side is written where there is room for it. */
static inline float skin_square(const float *side, float x, float y, float *nearest)
{
    const float dx = side[2] - side[0], dy = side[3] - side[1], length = dx * dx + dy * dy;
    const float part = ((x - side[0]) * dx + (y - side[1]) * dy) / (length > 0.0f ? length : 1.0f);
    const float along = fminf(fmaxf(part, 0.0f), 1.0f);
    const float px = side[0] + along * dx, py = side[1] + along * dy;
    if (nearest) {
        nearest[0] = px;
        nearest[1] = py;
    }
    return (x - px) * (x - px) + (y - py) * (y - py);
}

/* The point of a pad that is nearest to x, y: a contact beside a pad loads the pad at its edge. */
static inline void skin_onto_pad(uint32_t pad, float x, float y, float *point)
{
    float least = INFINITY;
    int inside = 0;
    for (uint32_t s = 0; s < SKIN_SIDES; s++) {
        const float *side = skin_side[pad][s];
        float nearest[2];
        const float square = skin_square(side, x, y, nearest);
        if (square < least) {
            least = square;
            point[0] = nearest[0];
            point[1] = nearest[1];
        }
        if ((side[1] > y) != (side[3] > y) &&
            x < side[0] + (y - side[1]) * (side[2] - side[0]) / (side[3] - side[1]))
            inside = !inside;
    }
    if (inside) {
        point[0] = x;
        point[1] = y;
    }
}

/* The cubic B-spline at a distance of z knots from its centre. */
static inline float skin_bspline(float z)
{
    const float far = fmaxf(2.0f - fabsf(z), 0.0f);
    return fabsf(z) < 1.0f ? 2.0f / 3.0f - z * z + 0.5f * z * z * fabsf(z) : far * far * far / 6.0f;
}

/* Log of the gain of a pad at a place on it, m; see LOCATION above. */
static inline float skin_log_gain(uint32_t pad, float x, float y)
{
    const float *b = skin_field[pad];
/*@FIELD@*/
}

/* Gain of a pad for a contact at a place, m; 1 where no place is known. */
static inline float skin_gain(uint32_t pad, const float *place)
{
    float at[2] = {0.0f, 0.0f};
    if (!(isfinite(place[0]) && isfinite(place[1])))
        return 1.0f;
    skin_onto_pad(pad, place[0], place[1], at);
    for (uint32_t axis = 0; axis < 2; axis++)
        at[axis] = fminf(fmaxf(at[axis], skin_reach[pad][axis]), skin_reach[pad][2 + axis]);
    return expf(skin_log_gain(pad, at[0], at[1]));
}

