"""Format 3: searches for objects, and the objects found."""

import sqlalchemy as sa
from alembic import op

from sorvolo.store.site.schema import String

revision = "3"
down_revision = "2"


def upgrade() -> None:
    """From format 2, which searched for nothing."""
    op.create_table(
        "searches",
        sa.Column(
            "run_id", sa.Integer, sa.ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True
        ),
        sa.Column("model", String, nullable=False),
        sa.Column("outlines_m", sa.JSON, nullable=False),
    )
    op.create_table(
        "objects",
        sa.Column(
            "run_id", sa.Integer, sa.ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True
        ),
        sa.Column("number", sa.Integer, primary_key=True),
        sa.Column("id", String, nullable=False),
        sa.Column("properties", sa.JSON, nullable=False),
    )
