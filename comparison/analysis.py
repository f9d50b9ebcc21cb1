"""Points, curves and comparisons at equal error or cost from the runs of a scene; see results.schema.json."""

from . import curves, metrics

COSTS = ("seconds", "rays")


def points_by_cost(renders, metric):
    """Return a list of (cost, `curves.Point`s) for each of `COSTS` from results of runs (see worker.run). Omits runs
    that failed, have no errors, or do not count the cost."""
    found = {cost: {} for cost in COSTS}
    for render in renders:
        if "error" in render or "errors" not in render:
            continue
        errors, key = render["errors"], (render["label"], render["setting"])
        for cost in COSTS:
            value = cost_of(render, cost)
            if value is not None:
                point = found[cost].setdefault(key, curves.Point(*key, {}, {}, {}))
                point.cost[render["seed"]] = value
                point.error[render["seed"]] = errors[metric]
                point.noise[render["seed"]] = float(metrics.detection_threshold(metric, errors["noise"]))
    return [(cost, list(found[cost].values())) for cost in COSTS]


def cost_of(render, cost):
    """Return the render seconds of a run, or its shadow rays per pixel (None: not counted)."""
    if cost == "seconds":
        return render["seconds"]
    return None if render["rays_per_sample"] is None else render["rays_per_sample"] * render["spp"]


def make_curves(points, labels):
    """Return the `curves.Curve`s of points in the order of the labels; a label without points has no curve."""
    found = [curves.Curve(label, [point for point in points if point.label == label]) for label in labels]
    return [curve for curve in found if curve.points]


def analyse(renders, labels, metric):
    """Return "points", "equal_errors" and "equal_costs" of a scene. The latter two are empty unless at least two labels
    have points and one of these has several."""
    described, at_errors, at_costs = [], {}, {}
    for cost, points in points_by_cost(renders, metric):
        best = curves.pareto(points)
        for point in points:
            described.append(_describe(cost, point, (point.label, point.name) in best))
        found = make_curves(points, labels)
        if len(found) > 1 and any(len(curve.points) > 1 for curve in found):
            at_errors[cost], at_costs[cost] = curves.equal_errors(found), curves.equal_costs(found)
    return {"points": described, "equal_errors": at_errors, "equal_costs": at_costs}


def spread_of(point):
    """Return the mean and confidence interval of the cost and of the error of a point (see `curves.spread`)."""
    return curves.spread(list(point.cost.values())), curves.spread(list(point.error.values()))


def _describe(cost, point, is_best):
    value, error = spread_of(point)
    return {
        "label": point.label,
        "setting": point.name,
        "cost": cost,
        "value": value,
        "error": error,
        "seeds": sorted(point.cost),
        "below_noise": point.mean() is None,
        "pareto": is_best,
    }
