"""`modelserver dynamics`: mass, center of mass, inertia, equations of motion, tip-over margin and wheel loads."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from mstools.terminal.options import (
    JsonOption,
    ModelOption,
    PrefixOption,
    TimeoutOption,
    UrlOption,
    Variables,
    argument,
    list_given,
    option,
    parse_pairs,
    parse_variables,
)
from mstools.terminal.output import escape, load_given_model, to_json

if TYPE_CHECKING:
    from modelserver.dynamics import CenterOfMass, Dynamics, Stability


def command(
    ctx: typer.Context,
    frame: Annotated[str, argument("FRAME", "Frame of center of mass and inertia. Default: the base frame.")] = "",
    model: ModelOption = None,
    config: Annotated[
        Path | None, option("--config -c FILE", "Use geometry, base frame and contacts of this vehicle file.")
    ] = None,
    settings: Variables = None,
    joints: Annotated[
        list[str] | None, option("--joint NAME=VALUE", "Position of a coordinate, rad or m. May be repeated.")
    ] = None,
    payload: Annotated[
        list[str] | None, option("--payload FRAME=KG", "Point mass at a frame. May be repeated.")
    ] = None,
    masses: Annotated[list[str] | None, option("--mass BODY=KG", "Another mass of a body. May be repeated.")] = None,
    contacts: Annotated[
        list[str] | None,
        option("--contact FRAME", "Contact with the ground, or a pattern like Cart:*Wheel. May be repeated."),
    ] = None,
    tilt: Annotated[tuple[float, float], option("--tilt-deg ROLL PITCH", "Attitude of the root frame.")] = (0.0, 0.0),
    acceleration: Annotated[
        tuple[float, float, float], option("--acceleration X Y Z", "Acceleration of the root frame in the world, m/s2.")
    ] = (0.0, 0.0, 0.0),
    floating: Annotated[bool, option("--floating", "Six coordinates for the base, too.")] = False,
    equations: Annotated[bool, option("--equations", "Print coordinates, gravity and mass matrix.")] = False,
    npy: Annotated[Path | None, option("--npy FILE", "Write the mass matrix to this file.")] = None,
    allow_massless: Annotated[bool, option("--allow-massless", "Count bodies without inertia as massless.")] = False,
    cut_loops: Annotated[bool, option("--cut-loops", "Leave constraints that close loops out.")] = False,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 1.0,
) -> None:
    """Print mass, center of mass, inertia, equations of motion and tip-over margin of a vehicle.

    Queries the running daemon for the vehicle as it is now, or computes with --model or --config. There a payload,
    another mass or other positions of joints may be given: margin and loads are printed beside those without.

    \b
    Example:
      modelserver dynamics --model config/raptor/geometry.yaml --joint FLEALateral=0.5 --equations
    """
    if model is None and config is None:
        of_file = {"settings", "joints", "payload", "masses", "contacts", "tilt", "acceleration"}
        if wrong := list_given(ctx, of_file | {"allow_massless", "cut_loops"}):
            raise typer.BadParameter(
                "has no effect on the running daemon, which has its own; add --model FILE or --config FILE",
                param_hint=next(iter(wrong.values())),
            )
        _show(*_query_daemon(frame, floating, equations, npy is not None, url, prefix, timeout), npy, as_json)
        return
    from modelserver.dynamics import MassUncertainty, assess_stability, find_contacts
    from modelserver.dynamics.stability import DynamicsSettings
    from modelserver.transforms import so3

    root, known, variables = "", DynamicsSettings(), parse_variables(settings)
    if config is not None:
        from modelserver.config.vehicle_file import load_config

        vehicle = load_config(config)
        root, known = vehicle.base_frame, vehicle.dynamics or known
        model, variables = model or Path(vehicle.geometry), vehicle.variables | variables
    assert model is not None
    geometry = load_given_model(model, variables)
    options: dict[str, Any] = {
        "allow_massless": allow_massless or known.allow_massless,
        "cut_loops": cut_loops or known.cut_loops,
        "uncertainty": MassUncertainty(known.mass_sigma, known.center_sigma, unstated_is_exact=True),
    }
    parse = partial(parse_pairs, form="NAME=NUMBER", parse=float)
    changes = {"masses": parse(masses, hint="--mass"), "payload": parse(payload, hint="--payload")}
    dynamics: Dynamics = geometry.dynamics("floating", root, **options, **changes)
    root = dynamics.tree.root
    attitude = so3.logarithm(so3.from_rpy(math.radians(tilt[0]), math.radians(tilt[1]), 0.0))
    base = {f"{root}.{name}": value for name, value in zip(("rx", "ry", "rz"), attitude, strict=True)}
    moved = parse(joints, hint="--joint")
    a = (
        {f"{root}.{name}": value for name, value in zip("xyz", acceleration, strict=True)}
        if any(acceleration)
        else None
    )
    sigma = dynamics.stated_sigmas
    q = base | moved
    center: CenterOfMass = dynamics.center_of_mass(q, frame=frame or root, sigma=sigma)
    inertia = dynamics.inertia(q, frame or root)
    data = _describe_mass(center.mass, frame or root, center.position, center.covariance, inertia)
    data |= {"massless": list(dynamics.massless), "cut": list(dynamics.cut)}
    names = find_contacts(geometry, contacts or ()) or known.contacts
    if names:
        v = None if a is None else dict[str, float]()
        found = assess_stability(dynamics, q, names, v, a, sigma=sigma)
        data["stability"] = _describe_stability(found)
        if moved or any(changes.values()):
            plain: Dynamics = geometry.dynamics("floating", root, **options)
            data["without changes"] = _describe_stability(assess_stability(plain, base, names, v, a, sigma=sigma))
    # with the base held, the rows and columns of the joints are left
    shown = slice(0 if floating else 6, None)
    D = dynamics.mass_matrix(q)[shown, shown]
    if equations:
        at = [q.get(name, value) for name, value in dynamics.by_name(dynamics.default_position).items()]
        gravity = dynamics.gravity(q).tolist()
        data |= _describe_equations(dynamics.coordinates[shown], at[shown], gravity[shown], D)
    _show(data, D, npy, as_json)


def _query_daemon(
    frame: str, floating: bool, equations: bool, has_matrix: bool, url: str, prefix: str, timeout: float
) -> tuple[dict[str, Any], Any]:
    """Return the running daemon's answer, and the mass matrix."""
    from modelserver.client.remote import Platform

    with Platform(url, channel_prefix=prefix, timeout=timeout, name="modelserver") as platform:
        found = platform.get_dynamics(frame, equations=equations or has_matrix, floating=floating)
    D = np.array(found.mass_matrix).reshape((len(found.coordinates),) * 2)
    covariance = None if found.center_covariance is None else np.array(found.center_covariance).reshape(3, 3)
    inertia = np.array(found.inertia).reshape(6, 6)
    data = _describe_mass(found.mass, found.frame, np.array(found.center), covariance, inertia)
    data["utime"], data["invalid_reasons"] = found.utime, found.invalid_reasons.explain()
    if equations:
        data |= _describe_equations(found.coordinates, found.position, found.gravity, D) | {"bias": found.bias}
    return data, D


def _show(data: dict[str, Any], D: Any, npy: Path | None, as_json: bool) -> None:
    if npy is not None:
        np.save(npy, D)
    typer.echo(json.dumps(to_json(data), indent=2) if as_json else format_dynamics(data))


def _describe_mass(mass: float, frame: str, center: Any, covariance: Any, inertia: Any) -> dict[str, Any]:
    sigma = None if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    return {"mass": mass, "frame": frame, "center": center.tolist(), "center_sigma": sigma, "inertia": inertia.tolist()}


def _describe_equations(
    coordinates: Sequence[str], position: Sequence[float], gravity: Sequence[float], D: Any
) -> dict[str, Any]:
    return {
        "coordinates": list(coordinates),
        "position": list(position),
        "gravity": list(gravity),
        "mass_matrix": D.tolist(),
    }


def _describe_stability(found: Stability) -> dict[str, Any]:
    """Return the weaker one of the two margins, as data."""
    margin = found.dynamic or found.static
    return {
        "margin_deg": math.degrees(margin.margin),
        "sigma_deg": math.degrees(margin.sigma),
        "measure": margin.measure,
        "edge": list(margin.edge),
        "loads": dict(margin.loads),
    }


def format_dynamics(data: Mapping[str, Any]) -> str:
    x, y, z = data["center"]
    lines = [
        f"mass            {data['mass']:.3f} kg",
        f"center of mass  {x + 0.0:.4f}  {y + 0.0:.4f}  {z + 0.0:.4f}  m in {escape(data['frame'])}",
    ]
    if data["center_sigma"] is not None:
        lines.append("sigma           " + "  ".join(f"{value:.4f}" for value in data["center_sigma"]) + "  m")
    moments = "  ".join(f"{value:.4g}" for value in np.diag(data["inertia"])[3:])
    lines.append(f"moments there   {moments}  kg m2 about x, y, z")
    for key, what in (("massless", "massless"), ("cut", "cut loops")):
        if data.get(key):
            lines.append(f"{what:<15} {escape(', '.join(data[key]))}")
    for key, what in (("stability", "tip-over margin"), ("without changes", "without changes")):
        if key in data:
            each = data[key]
            sigma = "" if math.isnan(each["sigma_deg"]) else f" +- {each['sigma_deg']:.2f}"
            edge = escape(" - ".join(each["edge"]))
            tips = "  TIPS" if each["margin_deg"] < 0.0 else ""
            lines.append(f"{what} {each['margin_deg']:.2f}{sigma} deg about {edge}, {each['measure']:.0f} N rad{tips}")
            lines += [f"  {load:8.0f} N  {escape(name)}" for name, load in each["loads"].items()]
    if "coordinates" in data:
        lines.append("coordinates (position, gravity vector, row of the mass matrix)")
        for name, position, gravity, row in zip(
            data["coordinates"], data["position"], data["gravity"], data["mass_matrix"], strict=True
        ):
            numbers = " ".join(f"{value + 0.0:9.4g}" for value in row)
            lines.append(f"  {escape(name)}  {position:.4g}  {gravity + 0.0:.4g}  | {numbers}")
    if data.get("invalid_reasons"):
        lines.append(f"NOT VALID       {data['invalid_reasons']}")
    return "\n".join(lines)
