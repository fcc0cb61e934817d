"""Format 2: comparisons, their changes, and the verdicts on them; files that a replaced run leaves."""

import sqlalchemy as sa
from alembic import op

from sorvolo.store.site.schema import String

revision = "2"
down_revision = "1"


def upgrade() -> None:
    """From format 1, which compared nothing."""
    op.create_table(
        "leftovers",
        sa.Column(
            "run_id", sa.Integer, sa.ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True
        ),
        sa.Column("name", String, primary_key=True),
    )
    op.create_table(
        "comparisons",
        sa.Column(
            "version_id",
            sa.Integer,
            sa.ForeignKey("versions.id", ondelete="CASCADE"),
            primary_key=True,
        ),
        sa.Column("run_id", sa.Integer, nullable=False),
        sa.Column("kinds", sa.JSON, nullable=False),
    )
    op.create_table(
        "changes",
        sa.Column("id", String, primary_key=True),
        sa.Column(
            "run_id", sa.Integer, sa.ForeignKey("runs.id", ondelete="CASCADE"), nullable=False
        ),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("kind", String, nullable=False),
        sa.Column("properties", sa.JSON, nullable=False),
    )
    op.create_index("changes_by_run", "changes", ["run_id"])
    op.create_table(
        "reviews",
        sa.Column("change_id", String, primary_key=True),
        sa.Column("flight_id", String, nullable=False),
        sa.Column("verdict", String, nullable=False),
        sa.Column("at_utc", String, nullable=False),
        sa.Column("note", String, nullable=False),
        sa.Column("kind", String, nullable=False),
        sa.Column("outline_m", sa.JSON, nullable=False),
    )
