"""A ledger in a PostgreSQL database."""

from typing import Any

from sqlalchemy import Connection, Dialect, Engine, create_engine, event

from app.errors import ForeignLedger, LedgerMissing
from app.flight_intents import HeldReservations
from app.ledger.location import Location

# "AMTX": the first half of the keys of our advisory locks.
_LOCKS = 0x414D5458
# Servers allow a hundred connections by default, for all processes together; who finds none free waits a little.
_READERS, _WAIT_S = 10, 5
# A server that does not answer is given up after some seconds, not when TCP gives up.
_CONNECT = {
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,
    "application_name": "airmatrix",
}
# Whoever writes waits this long for the lock; a process that freezes with the lock in its hands loses it after this.
_LOCK = "10s"
_IDLE = "30s"
# Whoever reads has this long; loading the index may take longer.
_READ = "30s"


class PostgresqlDatabase:
    """One PostgreSQL database (or one schema, where the URL's options set `search_path`)."""

    def __init__(self, location: Location) -> None:
        self.location = location

    def create(self) -> None:
        """Do nothing: migrations make the tables."""

    def check(self) -> None:
        """Do nothing: only a connection shows what is there."""

    def check_tables(self, connection: Connection, *, may_be_empty: bool) -> None:
        """Raise `ForeignLedger` if the database holds tables that are no ledger's, `LedgerMissing` if it has none."""
        tables, marks = connection.exec_driver_sql(
            "SELECT count(*), count(*) FILTER (WHERE obj_description(oid, 'pg_class') = 'AirMatrix ledger')"
            " FROM pg_class WHERE relnamespace = current_schema()::regnamespace AND relkind IN ('r', 'p', 'v', 'm')"
            # Extensions bring tables of their own.
            " AND NOT EXISTS (SELECT 1 FROM pg_depend WHERE objid = pg_class.oid AND deptype = 'e')"
        ).one()
        if tables and not marks:
            raise ForeignLedger(f"{self.location} has tables, but is no AirMatrix ledger; nothing was changed in it")
        if not tables and not may_be_empty:
            raise LedgerMissing(f"there is no ledger at {self.location}; `airmatrix serve` creates one")

    def engine(self, *, writes: bool, migrates: bool = False) -> Engine:
        """Return an engine whose transactions hold the airspace's advisory lock from the start, or cannot write at all.

        Writing needs READ COMMITTED: a snapshot taken before the lock would be stale under it. Reading wants one
        snapshot for all statements of a transaction.
        """
        engine = create_engine(
            self.location.url,
            pool_size=1 if writes else _READERS,
            max_overflow=0,
            pool_timeout=_WAIT_S,
            # Restarts of the server show here, not in the first request after them.
            pool_pre_ping=True,
            isolation_level="READ COMMITTED" if writes else "REPEATABLE READ",
            connect_args=_CONNECT,
            execution_options={} if writes else {"postgresql_readonly": True},
        )

        @event.listens_for(engine, "do_connect")
        def connect(dialect: Dialect, _record: object, arguments: list[Any], parameters: dict[str, Any]) -> Any:
            connection: Any = dialect.connect(*arguments, **parameters)
            encoding = connection.info.parameter_status("server_encoding")
            if encoding != "UTF8":
                connection.close()
                raise ForeignLedger(
                    f"{self.location} is encoded in {encoding}, in which not every name can be written; "
                    "make it with: createdb --encoding UTF8 --template template0"
                )
            return connection

        @event.listens_for(engine, "connect")
        def configure(connection: Any, _record: object) -> None:
            with connection.cursor() as cursor:
                cursor.execute(f"SET lock_timeout = '{_LOCK}'")
                cursor.execute(f"SET idle_in_transaction_session_timeout = '{_IDLE}'")
                if not writes:
                    cursor.execute(f"SET statement_timeout = '{_READ}'")
                # A 201 is sent after the commit is durable, whatever the server's default.
                cursor.execute(
                    "SELECT set_config('synchronous_commit', 'on', false)"
                    " WHERE current_setting('synchronous_commit') = 'off'"
                )
            connection.commit()

        if writes:

            @event.listens_for(engine, "begin")
            def lock(connection: Connection) -> None:
                airspace = "0" if migrates else "'counters'::regclass::oid::int4"
                connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_LOCKS}, {airspace})")

        return engine

    def is_undone_by(self, error: Exception) -> bool:
        """Return False: whatever happened to the connection, the server may have gone on."""
        del error
        return False

    def checkpoint(self) -> None:
        """Do nothing: the server sees to it."""

    def close(self) -> None:
        """Do nothing: there is nothing that `checkpoint` holds."""

    def insert_reservations(self, connection: Connection, held: HeldReservations) -> None:
        """Insert reservations in one statement."""
        columns = [column.tolist() for column in (held.block, held.enter_ms, held.exit_ms, held.sequence)]
        connection.exec_driver_sql(
            'INSERT INTO reservations (block, enter, "exit", intent)'
            " SELECT * FROM unnest(%s::bigint[], %s::bigint[], %s::bigint[], %s::bigint[])",
            tuple(columns),
        )
