"""A layout of Foxglove that shows a drive as `FoxgloveWriter` logs it: scene, map, validity, plots, messages.

    3D               validity, reasons
    map              speed, heading, uncertainty, innovations
    messages, events, diagnostics (tabs below)

The plots share their time axis. What a drive has by name is given: its base frame, sources of fixes, innovations.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import Final

from foxglove.layouts import (
    BasePanel,
    BaseRendererGridLayerSettings,
    BaseRendererPoseTopicSettings,
    BaseRendererSceneSettings,
    BaseRendererSceneUpdateTopicSettings,
    BaseRendererTransforms,
    Content,
    DiagnosticsSummaryConfig,
    DiagnosticsSummaryPanel,
    IndicatorConfig,
    IndicatorPanel,
    IndicatorRule,
    Layout,
    LogConfig,
    LogPanel,
    MapConfig,
    MapPanel,
    MapTopicSettings,
    PlotConfig,
    PlotPanel,
    PlotSeries,
    RawMessagesConfig,
    RawMessagesPanel,
    SplitContainer,
    SplitItem,
    StateTransitionsConfig,
    StateTransitionsPanel,
    StateTransitionsSeries,
    TabContainer,
    TabItem,
    ThreeDeeCameraState,
    ThreeDeeConfig,
    ThreeDeePanel,
)

from modelserver.geometry import names
from mstools.foxglove.writer import (
    DIAGNOSTICS_TOPIC,
    EVENTS_TOPIC,
    FIX_PREFIX,
    MODEL_TOPIC,
    NIS_TOPIC,
    POSE_FIX_TOPIC,
    POSE_TOPIC,
    STATE_TOPIC,
    UNCERTAINTY_TOPIC,
    WORLD,
)
from mstools.report.charts import PALETTE

GREEN: Final = "#3cb45a"
RED: Final = "#e1463c"


def make_layout(base_frame: str, sources: Collection[str] = (), measurements: Collection[str] = ()) -> Layout:
    """Return the layout of a drive.

    Parameters
    ----------
    base_frame : the frame that the scene follows; empty where it is not known
    sources : the sources of fixes
    measurements : the labels of innovations; without any, the panel plots those that come
    """
    plots = (
        _make_plot("Speed (m/s)", [_make_series("speed", "speed")], low=0.0),
        _make_plot("Heading (degrees from grid north)", [_make_series("heading_deg", "heading", 1)]),
        _make_plot(
            "Horizontal uncertainty (m)",
            [
                _make_series("horizontal_sigma", "sigma"),
                _make_series("horizontal_protection_level", "protection level", 1),
            ],
            low=0.0,
        ),
        _make_plot("Innovations: NIS per degree of freedom", _make_innovations(measurements), low=0.0),
    )
    messages = TabContainer(
        tabs=[
            TabItem(title="State", content=RawMessagesPanel(config=RawMessagesConfig(topic_path=STATE_TOPIC))),
            TabItem(title="Pose", content=RawMessagesPanel(config=RawMessagesConfig(topic_path=POSE_TOPIC))),
            TabItem(title="Events", content=LogPanel(config=LogConfig(topic_to_render=EVENTS_TOPIC))),
            TabItem(
                title="Diagnostics",
                content=DiagnosticsSummaryPanel(config=DiagnosticsSummaryConfig(topic_to_render=DIAGNOSTICS_TOPIC)),
            ),
        ]
    )
    left = _split("column", (5, _make_scene(base_frame)), (3, _make_map(sources)), (2, messages))
    right = _split("column", (1, _make_indicator()), (2, _make_transitions()), *((3, each) for each in plots))
    return Layout(content=_split("row", (3, left), (2, right)))


def _split(direction: str, *items: tuple[float, Content]) -> SplitContainer:
    return SplitContainer(
        direction="row" if direction == "row" else "column",
        items=[SplitItem(proportion=proportion, content=content) for proportion, content in items],
    )


def _make_scene(base_frame: str) -> BasePanel:
    return ThreeDeePanel(
        config=ThreeDeeConfig(
            follow_tf=names.shorten(base_frame) or None,
            follow_mode="follow-position",
            fixed_frame=names.shorten(WORLD),
            camera_state=ThreeDeeCameraState(
                perspective=True, distance=12.0, phi=60.0, theta_offset=45.0, fovy=45.0, near=0.1, far=5000.0
            ),
            scene=BaseRendererSceneSettings(
                mesh_up_axis="z_up", transforms=BaseRendererTransforms(show_label=False, axis_size=0.2)
            ),
            topics={
                MODEL_TOPIC: BaseRendererSceneUpdateTopicSettings(visible=True, show_outlines=False),
                UNCERTAINTY_TOPIC: BaseRendererSceneUpdateTopicSettings(visible=True, show_outlines=False),
                # its covariance would be drawn by its diagonal alone, and as one sigma
                POSE_TOPIC: BaseRendererPoseTopicSettings(visible=True, type="axis", show_covariance=False),
            },
            layers={
                "grid": BaseRendererGridLayerSettings(
                    instance_id="grid",
                    visible=True,
                    frame_id=names.shorten(WORLD),
                    size=200.0,
                    divisions=20.0,
                    color="#80808080",
                )
            },
        )
    )


def _make_map(sources: Collection[str]) -> BasePanel:
    fixes = [f"{FIX_PREFIX}{each}" for each in sorted(sources)]
    colors = {topic: PALETTE[number % len(PALETTE)] for number, topic in enumerate((POSE_FIX_TOPIC, *fixes))}
    return MapPanel(
        config=MapConfig(
            follow_topic=POSE_FIX_TOPIC,
            zoom_level=18.0,
            topic_colors=colors,
            topic_config={topic: MapTopicSettings(history_mode="previous", point_size=4.0) for topic in colors},
        )
    )


def _make_indicator() -> BasePanel:
    return IndicatorPanel(
        title="Pose",
        config=IndicatorConfig(
            path=f"{STATE_TOPIC}.valid",
            style="background",
            rules=[IndicatorRule(raw_value="true", operator="=", color=GREEN, label="VALID")],
            fallback_color=RED,
            fallback_label="NOT VALID",
        ),
    )


def _make_transitions() -> BasePanel:
    series = [StateTransitionsSeries(value=f"{STATE_TOPIC}.{name}", label=name) for name in ("valid", "reason")]
    return StateTransitionsPanel(title="Validity", config=StateTransitionsConfig(paths=series, is_synced=True))


def _make_series(field: str, label: str, color: int = 0) -> PlotSeries:
    return PlotSeries(value=f"{STATE_TOPIC}.{field}", label=label, color=PALETTE[color])


def _make_innovations(measurements: Collection[str]) -> list[PlotSeries]:
    if not measurements:
        return [PlotSeries(value=f"{NIS_TOPIC}.measurements", dynamic_label_field="label", dynamic_value_field="value")]
    return [
        PlotSeries(
            value=f"{NIS_TOPIC}.measurements[:]{{label=={json.dumps(label)}}}.value",
            label=label,
            color=PALETTE[number % len(PALETTE)],
            show_line=False,
        )
        for number, label in enumerate(sorted(measurements))
    ]


def _make_plot(title: str, series: list[PlotSeries], low: float | None = None) -> BasePanel:
    return PlotPanel(
        title=title, config=PlotConfig(paths=series, min_y_value=low, is_synced=True, show_plot_values_in_legend=True)
    )
