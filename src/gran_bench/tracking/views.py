"""What the UI shows before anyone has set it up: a description, a view of the runs, the metric that matters.

MLflow keeps a saved view as a tag of the experiment: ``mlflow.sharedViewState.<id>``, an envelope with a name, two
times and the state of the run table and of the charts as JSON text. The keys of that state are those that MLflow 3.17
reads; a tag that it cannot read it ignores.
"""

from __future__ import annotations

import json
from typing import Any

from gran_bench.tracking.names import HEADLINE

VIEW = "what-matters"
VIEW_TAG = f"mlflow.sharedViewState.{VIEW}"
RUN_NAME, DATASET = "attributes.`Run Name`", "attributes.`Dataset`"  # columns, as the UI names them
WIDE_NAME, WIDE_FIGURE = 300, 170  # pixels of a column

# From left to right in the table.
COLUMN_METRICS = (
    *("angle error floors", "com angle error floors", "speed W1 floors", "position error 10 frames mm"),
    *("rollout ms per frame", "requirements failed", "rollouts failed", "training minutes"),
)
COLUMN_PARAMS = ("model.name", "model.radius_diameters", "boundary.kind", "loss terms", "frames ahead", "seed")
COLUMN_TAGS = ("sweep", "scene", "judged")
# Axes from left to right: what was chosen, then what came out.
AXES_PARAMS = ("model.name", "model.radius_diameters", "boundary.kind", "loss terms", "frames ahead")
ERRORS = ("angle error floors", "com angle error floors", "speed W1 floors")
CHOICES, TIMES = "choices against error", "error against time"  # sections of the charts

DESCRIPTION = (
    f"**What matters?** The saved view *{VIEW}* (menu Views) shows each run's headline figures, best angle of repose "
    "first; the button with the curve shows its charts: choices against error, error against time. Errors are in "
    "multiples of the noise floor: 1 is as good as the DEM against itself.\n\n"
    "A run's page shows its figures; each figure carries the name of its run. To compare runs, tick them and choose "
    "*Compare*. Failures stay in: *requirements failed*, *rollouts failed*."
)


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
    columns = [f"metrics.`{HEADLINE}{name}`" for name in COLUMN_METRICS]
    columns += [f"params.`{name}`" for name in COLUMN_PARAMS] + [f"tags.`{name}`" for name in COLUMN_TAGS]
    return {
        **{"searchFilter": "", "orderByKey": f"metrics.`{HEADLINE}angle error floors`", "orderByAsc": True},
        **{"startTime": "ALL", "lifecycleFilter": "Active", "modelVersionFilter": "All Runs", "datasetsFilter": []},
        "selectedColumns": [*columns, DATASET],
        "columnOrder": [RUN_NAME, *columns, DATASET],
        "columnWidths": {RUN_NAME: WIDE_NAME, **{column: WIDE_FIGURE for column in columns}},
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
