"""Constraints in the ledger: rows that stay as they are but for their removal."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import orjson
from sqlalchemy import ColumnElement, Connection, Row, and_, delete, func, insert, or_, select, update

from app.constraints import MOST_CONSTRAINTS, Constraint
from app.ledger.tables import constraints

CREATED, REMOVED = CONSTRAINT_KINDS = ("constraint_created", "constraint_removed")

# So many are kept in memory, also some that are asked for no more.
_KNOWN = 2 * MOST_CONSTRAINTS


class KnownConstraints:
    """The constraints that were read before, by id: their blocks are many, and asked for every second.

    Several threads may ask.
    """

    def __init__(self) -> None:
        self._known: dict[str, Constraint] = {}

    def in_force(self, connection: Connection, at_ms: int) -> tuple[Constraint, ...]:
        """Return the constraints in force at a time, by number: none that was made later, but those removed since."""
        row = constraints.c
        not_removed = or_(row.removed.is_(None), row.removed > at_ms)
        query = select(row.id, row.removed).where(row.created <= at_ms, row.begins <= at_ms, _ends_after(at_ms))
        found = connection.execute(query.where(not_removed).order_by(row.number)).all()
        known = self._known
        missing = [row.id for row in found if row.id not in known]
        if missing:
            read = connection.execute(select(constraints).where(constraints.c.id.in_(missing)))
            if len(known) + len(missing) > _KNOWN:
                known = {row.id: known[row.id] for row in found if row.id in known}
            self._known = known = known | {row.id: to_constraint(row) for row in read}
        return tuple(replace(known[row.id], removed_ms=row.removed) for row in found)


def record(connection: Connection, constraint: Constraint) -> Constraint:
    """Write a constraint under the next number, and return it with that."""
    number = connection.execute(select(func.coalesce(func.max(constraints.c.number), 0))).scalar_one() + 1
    row = {
        "number": number,
        "id": constraint.id,
        "name": constraint.name,
        "polygon": orjson.dumps(constraint.polygon).decode(),
        "blocks": orjson.dumps(constraint.blocks, option=orjson.OPT_SERIALIZE_NUMPY).decode(),
        "base_m": constraint.base_m,
        "top_m": constraint.top_m,
        "begins": constraint.from_ms,
        "ends": constraint.until_ms,
        "created": constraint.created_ms,
        "removed": constraint.removed_ms,
    }
    connection.execute(insert(constraints).values(row))
    return replace(constraint, number=number)


def remove(connection: Connection, constraint: Constraint, now_ms: int) -> Constraint:
    """Mark a constraint as removed; its row stays, for those who ask for the past."""
    this = constraints.c.number == constraint.number
    connection.execute(update(constraints).where(this).values(removed=now_ms))
    return replace(constraint, removed_ms=now_ms)


def forget(connection: Connection, before_ms: int, limit: int) -> int:
    """Delete up to `limit` constraints that ended or were removed before a time; return how many.

    The newest stays: its number is what the next is counted from.
    """
    row = constraints.c
    newest = select(func.max(row.number)).scalar_subquery()
    over = or_(row.removed < before_ms, row.ends < before_ms)
    query = select(row.number).where(over, row.number < newest).order_by(row.number).limit(limit)
    numbers = list(connection.execute(query).scalars())
    if numbers:
        connection.execute(delete(constraints).where(row.number.in_(numbers)))
    return len(numbers)


def find(connection: Connection, constraint_id: str) -> Constraint | None:
    """Return a constraint, also one that has ended or was removed; None if there is none."""
    row = connection.execute(select(constraints).where(constraints.c.id == constraint_id)).one_or_none()
    return None if row is None else to_constraint(row)


def after(connection: Connection, time_ms: int, *, number: int = 0, limit: int | None = None) -> list[Constraint]:
    """Return up to `limit` constraints that are in force after a time, by number, those beyond `number`."""
    wanted = and_(constraints.c.number > number, _in_force_after(time_ms))
    query = select(constraints).where(wanted).order_by(constraints.c.number).limit(limit)
    return [to_constraint(row) for row in connection.execute(query)]


def count_after(connection: Connection, time_ms: int) -> int:
    """Return how many constraints are in force after a time."""
    query = select(func.count()).select_from(constraints).where(_in_force_after(time_ms))
    return int(connection.execute(query).scalar_one())


def ids_of(connection: Connection, numbers: Iterable[int]) -> tuple[str, ...]:
    """Return the ids of constraints by their numbers, in the order of these."""
    wanted = list(dict.fromkeys(numbers))
    if not wanted:
        return ()
    row = constraints.c
    found = connection.execute(select(row.number, row.id).where(row.number.in_(wanted)))
    ids = {each.number: each.id for each in found}
    return tuple(ids[number] for number in wanted if number in ids)


def to_constraint(row: Row[Any]) -> Constraint:
    """Return a row as a constraint."""
    return Constraint(
        number=row.number,
        id=row.id,
        name=row.name,
        polygon=orjson.loads(row.polygon),
        base_m=row.base_m,
        top_m=row.top_m,
        from_ms=row.begins,
        until_ms=row.ends,
        blocks=np.array(orjson.loads(row.blocks), dtype=np.int64),
        created_ms=row.created,
        removed_ms=row.removed,
    )


def _in_force_after(time_ms: int) -> ColumnElement[bool]:
    return and_(constraints.c.removed.is_(None), _ends_after(time_ms))


def _ends_after(time_ms: int) -> ColumnElement[bool]:
    return or_(constraints.c.ends.is_(None), constraints.c.ends > time_ms)
