/**
 * Returns the column of a boundary at row `y`, both in pixels of the image that was sent. Rows less than one row below
 * the horizon count as one row below. The curve is valid between the rows of `lane.line`.
 */
export function laneX(lane, y) {
    const [v, b, k] = lane.coefficients;
    const u = Math.max(y - lane.horizon, 1);
    return v + b * u + k / u;
}
/** Returns points [x, y] on a boundary, in pixels of the image that was sent. Both end rows are included. */
export function lanePoints(lane, options = {}) {
    const { from = lane.line.bottom[1], to = lane.line.top[1], step = 8 } = options;
    const count = Math.max(1, Math.ceil(Math.abs(to - from) / Math.max(step, 0.1)));
    return Array.from({ length: count + 1 }, (_, index) => {
        const y = from + ((to - from) * index) / count;
        return [laneX(lane, y), y];
    });
}
