"""What the UI shows before anyone has set it up: a description, a view of the runs, the metric that matters.

MLflow keeps a saved view as a tag of the experiment: ``mlflow.sharedViewState.<id>``, an envelope with a name, two
times and the state of the run table and of the charts as JSON text. The keys of that state are those that MLflow 3.17
reads; a tag that it cannot read it ignores.
"""

import json
from typing import Any

from gran_bench.tracking.names import HEADLINE, VERDICT

VIEW = "what-matters"
VIEW_TAG = f"mlflow.sharedViewState.{VIEW}"
RUN_NAME, DATASET = "attributes.`Run Name`", "attributes.`Dataset`"  # columns, as the UI names them
SHIPPED_TAG = "shipped"  # of a run that came with the project: where its record is
# Pixels of a column: the run's name, whole, and any other by the letters of its heading or of its cells.
WIDE_NAME, WIDE_LETTER, WIDE_EDGE, CELL_LETTERS = 460, 6, 28, {VERDICT: 34, "speed": 22, "model": 30, "scene": 14}

# From left to right in the table: what was judged, what came out, what was chosen, what it belongs to.
FIRST_TAGS = ("scene", "speed", "model", VERDICT)
COLUMN_METRICS = (
    *("angle error floors", "com angle error floors", "speed W1 floors", "rollout ms per frame"),
    *("requirements failed", "rollouts failed", "position error 10 frames mm", "training minutes"),
)
COLUMN_PARAMS = ("model.radius_diameters", "boundary.kind", "loss terms", "frames ahead", "seed")
LAST_TAGS = ("sweep", SHIPPED_TAG)
# Axes from left to right: what was chosen, then what came out.
AXES_PARAMS = ("model.name", "model.radius_diameters", "boundary.kind", "loss terms", "frames ahead")
ERRORS = ("angle error floors", "com angle error floors", "speed W1 floors")
CHOICES, TIMES = "choices against error", "error against time"  # sections of the charts

DESCRIPTION = (
    f"**What matters?** The saved view *{VIEW}* (menu Views) shows each run's headline figures, best angle of repose "
    "first; the button with the curve shows its charts: choices against error, error against time. Errors are in "
    "multiples of the noise floor: 1 is as good as the DEM against itself. Headline figures are rounded to three "
    "figures; the run's other metrics are not.\n\n"
    "A run's page shows its figures; each figure carries the name of its run. To compare runs, tick them and choose "
    f"*Compare*. Failures stay in: *requirements failed*, *rollouts failed*. A run whose *{VERDICT}* says *stopped* "
    f"goes on with its command. What came with the project has a tag *{SHIPPED_TAG}*; `tags.{SHIPPED_TAG} IS NULL` in "
    "the search field leaves it out."
)


def first_page(page: str, experiment_id: str) -> str:
    """MLflow's page as it opens the saved view where its address names no other place, instead of a welcome."""
    script = f"if (location.hash.length < 3) location.replace({json.dumps(view_path(experiment_id)[1:])})"
    return page.replace("<head>", f"<head><script>{script}</script>", 1)


def experiment_tags() -> dict[str, str]:
    """Tags that an experiment needs for the UI to start with what matters."""
    return {
        "mlflow.note.content": DESCRIPTION,
        "mlflow.experimentKind": "custom_model_development",
        "mlflow.experiment.primaryMetric.name": f"{HEADLINE}angle error floors",
        "mlflow.experiment.primaryMetric.greaterIsBetter": "false",
        # The times only sort the menu; fixed, so that the tag is the same whoever writes it.
        VIEW_TAG: json.dumps({"name": VIEW, "createdAt": 0, "updatedAt": 0, "state": json.dumps(view_state())}),
    }


def view_path(experiment_id: str, charts: bool = False) -> str:
    """Path and fragment of the saved view's page in the UI, as its table or its charts."""
    mode = "&compareRunsMode=CHART" if charts else ""
    return f"/#/experiments/{experiment_id}/runs?viewStateShareKey={VIEW}&workflowType=machine_learning{mode}"


def view_state() -> dict[str, Any]:
    """The state of the run table and of the charts, in the words of the UI."""
    groups = (("tags", FIRST_TAGS), ("metrics", [HEADLINE + name for name in COLUMN_METRICS]))
    groups += (("params", COLUMN_PARAMS), ("tags", LAST_TAGS))
    headings = {f"{group}.`{name}`": name for group, names in groups for name in names}
    columns = list(headings)
    letters = {column: max(len(name), CELL_LETTERS.get(name, 0)) for column, name in headings.items()}
    return {
        **{"searchFilter": "", "orderByKey": f"metrics.`{HEADLINE}angle error floors`", "orderByAsc": True},
        **{"startTime": "ALL", "lifecycleFilter": "Active", "modelVersionFilter": "All Runs", "datasetsFilter": []},
        "selectedColumns": [*columns, DATASET],
        "columnOrder": [RUN_NAME, *columns, DATASET],
        "columnWidths": {
            RUN_NAME: WIDE_NAME,
            **{column: WIDE_EDGE + WIDE_LETTER * count for column, count in letters.items()},
        },
        **{"runsExpanded": {}, "runsPinned": [], "runsHidden": [], "runsVisibilityMap": {}},
        "runsHiddenMode": "SHOW_ALL",
        "compareRunCharts": _charts(),
        "compareRunSections": [
            {"uuid": name, "name": name, "columns": columns, "display": True, "isReordered": True, **_CHARTS_SHOWN}
            for name, columns in ((CHOICES, 1), (TIMES, 2), ("headline", 3), ("training", 3))
        ],
        **{"viewMaximized": False, "runListHidden": False, "isAccordionReordered": True, "groupBy": None},
        **{"groupsExpanded": {}, "autoRefreshEnabled": True, "useGroupedValuesInCharts": True, "hideEmptyCharts": True},
        "globalLineChartConfig": {"xAxisKey": "step", "lineSmoothness": 0, "selectedXAxisMetricKey": ""},
        "chartsSearchFilter": "",
    }


def _charts() -> list[dict[str, Any]]:
    """Choices against errors, error against time, then a bar for each headline figure, and the loss."""
    time, failed = f"{HEADLINE}rollout ms per frame", f"{HEADLINE}requirements failed"
    placed = []
    # One for each error, because a run without it has no line: a short drum has no straight surface, so no angle.
    for name in ERRORS:
        chart = {"type": "PARALLEL", "displayName": f"choices against {name}", "selectedParams": list(AXES_PARAMS)}
        placed.append((CHOICES, chart | {"selectedMetrics": [time, failed, HEADLINE + name], "showAllRuns": True}))
    for name in ERRORS:
        x, y = ({"key": key, "type": "METRIC"} for key in (time, HEADLINE + name))
        placed.append((TIMES, {"type": "SCATTER", "xaxis": x, "yaxis": y}))
    for name in COLUMN_METRICS:
        placed.append(("headline", {"type": "BAR", "metricKey": HEADLINE + name, "displayName": name}))
    loss = {"type": "LINE", "metricKey": "training/loss", "displayName": "loss", "scaleType": "log"}
    placed.append(("training", loss))
    return [
        {"uuid": f"chart-{i}", "metricSectionId": section, **_CHARTS_SHOWN, "runsCountToCompare": 100, **chart}
        for i, (section, chart) in enumerate(placed)
    ]


_CHARTS_SHOWN = {"deleted": False, "isGenerated": False}
