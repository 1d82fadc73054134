"""What a column shows, in up to three sentences."""

from __future__ import annotations

from typing import Any

from leaderboard.board import Column
from leaderboard.tables.settings import Loss
from leaderboard.words import engineering, percent


def sentences(
    column: Column, rows: list[dict[str, Any]], steps: dict[str, Any] | None, given: Any
) -> list[str]:
    """Who is best and by how much; what partial views cost it; what its pose is worth.

    Args:
        rows: of the column, see ``rows.rows_of``.
        steps: the family of settings the column is of, see ``content.setting_data``, or None.
        given: its rows under given poses, see ``content.given_data``, or None.
    """
    main = [row for row in rows if row["main"]]
    return [
        text
        for text in (_best(main), _cost_of_settings(column, main, steps), _pose(main, given))
        if text
    ]


def cost(rows: list[dict[str, Any]]) -> list[str]:
    """What accuracy costs, in one sentence; none where only one model is there."""
    main = [row for row in rows if row["main"]]
    if len(main) < 2:
        return []
    first, cheapest = main[0], min(main, key=lambda row: row["multiply_adds"])
    text = f"{first['title']}, the most accurate, takes {_cost(first)} a cloud"
    if cheapest is not first:
        text += (
            f"; the cheapest, {cheapest['title']}, {_cost(cheapest)} at "
            f"{percent(cheapest['accuracy'], None)} %"
        )
    if len(main) == 2:
        other = "" if cheapest is not first else f"; {main[1]['title']} {_cost(main[1])}"
        return [f"{text}{other}."]
    dearer = sum(row["multiply_adds"] > first["multiply_adds"] for row in main[1:])
    return [f"{text}. Of the {len(main) - 1} others {dearer or 'none'} cost more than the first."]


def _cost(row: dict[str, Any]) -> str:
    return f"{engineering(row['multiply_adds'])} multiply-adds"


def _best(main: list[dict[str, Any]]) -> str:
    first, others = main[0], main[1:]
    text = f"{first['title']} names {_share(first)} of the test clouds rightly"
    if not others:
        return f"{text}; it is the only model tested here."
    alike = [row["title"] for row in others if row["rank"] == first["rank"]]
    ahead = f"{text}, {_points(others[0]['behind'])} more than the next, {others[0]['title']}"
    if not alike:
        return f"{ahead}."
    listed = ", ".join(alike[:3]) + (f" and {len(alike) - 3} more" if len(alike) > 3 else "")
    return f"{ahead}; of all pairs tested at once, it cannot be told apart from {listed}."


def _cost_of_settings(
    column: Column, main: list[dict[str, Any]], steps: dict[str, Any] | None
) -> str:
    if steps is None:
        if column.key[1] != "partial" or column.key[:2] != column.key[3:5]:
            return ""
        return (
            "How much worse this is than on complete clouds is not measured yet: no model here was "
            "trained and tested on complete clouds of these objects."
        )
    by_id = {row["id"]: row for row in steps["rows"]}
    row = next((by_id[r["id"]] for r in main if r["id"] in by_id), None)
    if row is None:
        return ""
    told = [
        f"{100 * share:.1f} % {_WHERE[setting]}"
        for setting, share in zip(steps["settings"], row["shares"], strict=True)
        if share is not None
    ]
    lost = [
        f"{_points(step)} are lost from {before} to {after}"
        for before, after, step in zip(
            steps["settings"], steps["settings"][1:], row["lost"], strict=False
        )
        if step is not None
    ]
    if not lost:
        return ""
    return f"After {steps['milestone']} clouds {row['title']} reaches {_list(told)}: {_list(lost)}."


_WHERE = {
    "aligned": "on complete clouds in a known pose",
    "z-rotated": "on complete clouds turned about their height",
    "rotated": "on complete clouds in any pose",
    "partial": "on what one side shows",
}


def _pose(main: list[dict[str, Any]], given: dict[str, Any] | None) -> str:
    posed = [row for row in main if row["pose"]]
    if not posed:
        return ""
    best = max(posed, key=lambda row: row["pose"]["top_1"])
    text = (
        f"The best pose is {best['title']}'s: the right one of 60 bins for "
        f"{100 * best['pose']['top_1']:.1f} % of the clouds, {best['pose']['median_deg']:.0f}° off "
        f"in the median"
    )
    gains = {row["id"]: row["gain"] for row in given["rows"]} if given else {}
    told = next((row for row in posed if gains.get(row["id"])), None)
    if told is None:
        return f"{text}. What the true pose would be worth to it is not tested yet (--test-pose 0)."
    gain: Loss = tuple(gains[told["id"]])
    return f"{text}; told the true pose, {told['title']} gains {_points(gain)}."


def _share(row: dict[str, Any]) -> str:
    text = f"{percent(row['accuracy'], None)} %"
    return text if row["low"] is None else f"{text} ({_range(row['low'], row['high'])})"


def _points(found: Any) -> str:
    mean, low, high = found
    text = f"{100 * mean:.1f} points"
    return text if low is None else f"{text} ({_range(low, high)})"


def _range(low: float, high: float) -> str:
    return f"{100 * low:.1f} to {100 * high:.1f}".replace("-", "−")


def _list(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
