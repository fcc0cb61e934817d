"""Format 1: flights, their runs and key frames, and the versions of the map with their tiles."""

import sqlalchemy as sa
from alembic import op

from sorvolo.store.site.schema import Nanoseconds, String

revision = "1"
down_revision = None


def upgrade() -> None:
    """From nothing."""
    op.create_table(
        "site",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("name", String, nullable=False),
        sa.Column("latitude_deg", sa.Float, nullable=False),
        sa.Column("longitude_deg", sa.Float, nullable=False),
        sa.Column("height_m", sa.Float, nullable=False),
        sa.Column("height_reference", String, nullable=False),
        sa.Column("crs", String, nullable=False),
        sa.Column("m_per_px", sa.Float, nullable=False),
        sa.Column("is_local", sa.Boolean, nullable=False),
        sa.Column("created_utc", String, nullable=False),
        sa.Column("derived_version", sa.Integer, nullable=False),
    )
    _flights()
    op.create_table(
        "versions",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("parent_id", sa.Integer, nullable=False),
        sa.Column("flight_id", String, sa.ForeignKey("flights.id"), nullable=False),
        sa.Column("run_id", sa.Integer, nullable=False),
        sa.Column("created_utc", String, nullable=False),
        sa.Column("complete", sa.Boolean, nullable=False),
        sa.Column("export_crs", String, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "version_tiles",
        sa.Column(
            "version_id",
            sa.Integer,
            sa.ForeignKey("versions.id", ondelete="CASCADE"),
            primary_key=True,
        ),
        sa.Column("tile_column", sa.Integer, primary_key=True),
        sa.Column("tile_row", sa.Integer, primary_key=True),
        sa.Column("sha256", String, nullable=False),
    )
    op.create_index("version_tiles_by_content", "version_tiles", ["sha256"])


def _flights() -> None:
    op.create_table(
        "flights",
        sa.Column("id", String, primary_key=True),
        sa.Column("rank", sa.Integer, nullable=False, unique=True),
    )
    op.create_table(
        "runs",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("flight_id", String, sa.ForeignKey("flights.id"), nullable=False),
        sa.Column("fingerprint", String, nullable=False),
        sa.Column("status", String, nullable=False),
        sa.Column("started_utc", String, nullable=False),
        sa.Column("finished_utc", String, nullable=False),
        sa.Column("method", String, nullable=False),
        sa.Column("settings", sa.JSON, nullable=False),
        sa.Column("frames", sa.JSON, nullable=False),
        sa.Column("notes", sa.JSON, nullable=False),
        sa.Column("files_written", sa.Boolean, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "keyframes",
        sa.Column(
            "run_id", sa.Integer, sa.ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True
        ),
        sa.Column("frame_index", sa.Integer, primary_key=True),
        sa.Column("name", String, nullable=False),
        sa.Column("time_ns", Nanoseconds, nullable=False),
        sa.Column("status", String, nullable=False),
        sa.Column("image_path", String, nullable=False),
        sa.Column("camera", sa.JSON, nullable=False),
        sa.Column("site_from_image", sa.JSON, nullable=False),
        sa.Column("rotation", sa.JSON, nullable=False),
        sa.Column("translation_m", sa.JSON, nullable=False),
        sa.Column("gains", sa.JSON, nullable=False),
        sa.Column("vignette", sa.JSON, nullable=False),
        sa.Column("sigma_m", sa.Float),
        sa.Column("residual_px", sa.Float),
    )
    op.create_table(
        "documents",
        sa.Column(
            "run_id", sa.Integer, sa.ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True
        ),
        sa.Column("name", String, primary_key=True),
        sa.Column("content", sa.LargeBinary, nullable=False),
    )
