"""Format 5: for which classes each frame was searched."""

import sqlalchemy as sa
from alembic import op

revision = "5"
down_revision = "4"


def upgrade() -> None:
    """From format 4; of searches that are stored it is not known."""
    op.add_column("searches", sa.Column("searched_for", sa.JSON))
