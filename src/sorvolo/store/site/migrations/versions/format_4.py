"""Format 4: when the flights were flown that made the versions; PostgreSQL, which began with it, numbers runs."""

import sqlalchemy as sa
from alembic import op

from sorvolo.store.site.schema import Nanoseconds, String

revision = "4"
down_revision = "3"


def upgrade() -> None:
    """From format 3; times are those of the flights whose key frames are stored."""
    op.create_table(
        "flown",
        sa.Column(
            "version_id",
            sa.Integer,
            sa.ForeignKey("versions.id", ondelete="CASCADE"),
            primary_key=True,
        ),
        sa.Column("first_ns", Nanoseconds, nullable=False),
        sa.Column("last_ns", Nanoseconds, nullable=False),
    )
    op.execute(
        "INSERT INTO flown SELECT versions.id, min(time_ns), max(time_ns) FROM versions "
        "JOIN keyframes ON keyframes.run_id = versions.run_id GROUP BY versions.id"
    )
    if op.get_bind().dialect.name == "postgresql":
        numbers = op.create_table(
            "numbers",
            sa.Column("name", String, primary_key=True),
            sa.Column("last", sa.BigInteger, nullable=False),
        )
        op.bulk_insert(
            numbers, [{"name": name, "last": 0} for name in ("runs", "versions", "writes")]
        )
