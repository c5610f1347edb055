"""Where a Dask cluster is: the address of a scheduler, or a file that describes one."""

import contextlib
import logging
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError

from alice_survey.core.config import Config
from alice_survey.core.contents import first_fault
from alice_survey.core.errors import ConfigError, WorkspaceError, why

if TYPE_CHECKING:
    from distributed import Client
    from distributed.security import Security

_CONNECT_S = 20
_LOOPBACK = {
    "LocalCluster": {
        "dashboard_address": "127.0.0.1:0",
        "worker_dashboard_address": "127.0.0.1:0",
    }
}
"""Options of classes without which their pages can be opened from other machines."""


class TlsConfig(Config):
    """Files of a connection that is encrypted and authenticated."""

    ca: Path
    """Certificate of the authority that signed those of scheduler and workers."""
    certificate: Path
    key: Path


class ClusterConfig(Config):
    """A cluster file: one of the first three."""

    address: str | None = None
    """Of a scheduler that runs."""
    scheduler_file: Path | None = None
    """Dask's own JSON file of such a scheduler."""
    start: str | None = None
    """Class of a cluster to start, such as `dask_jobqueue.SLURMCluster`."""
    workers: int | None = Field(None, ge=1)
    """With `start`: how many workers to ask for."""
    options: dict[str, Any] = Field(default_factory=dict)
    """With `start`: arguments of the class."""
    tls: TlsConfig | None = None

    def security(self) -> "Security | None":
        """How to connect; None for what Dask's own configuration says.

        Raises:
            ConfigError: the address is of an encrypted connection, and no file is named.
        """
        from distributed.security import Security

        if self.tls is None:
            own = Security()  # of Dask's configuration
            encrypted = (self.address or "").startswith("tls:")
            if encrypted and not own.get_connection_args("client").get("ssl_context"):
                raise ConfigError(
                    f"{self.address}: no certificates: name them under [tls] of a cluster file "
                    "(--cluster), or in Dask's configuration"
                )
            return None
        return Security(
            require_encryption=True,
            tls_ca_file=str(self.tls.ca),
            tls_client_cert=str(self.tls.certificate),
            tls_client_key=str(self.tls.key),
        )


@dataclass(frozen=True, kw_only=True)
class Connection:
    """A client of a scheduler."""

    client: "Client"
    address: str
    is_own: bool
    """Whether the cluster was started here, and its workers are still to come."""


@contextlib.contextmanager
def connect(scheduler: str | None, file: Path | None) -> Iterator[Connection]:
    """Within this block, be a client of a scheduler; a cluster that was started ends with it.

    Args:
        scheduler: its address.
        file: a cluster file, or Dask's JSON file of a scheduler, where no address is given.

    Raises:
        ConfigError: the file is wrong.
        WorkspaceError: Dask is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError:
        raise WorkspaceError(
            "a cluster needs Dask: pip install 'alice-survey[cluster]', here and on the workers"
        ) from None
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what ends a run is reported here
    config = ClusterConfig(address=scheduler) if file is None else read_cluster_file(file)
    with contextlib.ExitStack() as stack:
        where: dict[str, Any]
        if config.start is not None:
            cluster = stack.enter_context(_start_cluster(config))
            if config.workers is not None:
                cluster.scale(config.workers)
            address, where = cluster.scheduler_address, {"address": cluster}
        elif config.scheduler_file is not None:
            address = str(config.scheduler_file)
            if not config.scheduler_file.is_file():
                raise ConfigError(
                    f"{address}: no such file; it is what 'dask scheduler --scheduler-file' writes"
                )
            where = {"scheduler_file": address}
        else:
            address, where = str(config.address), {"address": config.address}
        try:
            client = stack.enter_context(
                Client(
                    **where, timeout=_CONNECT_S, security=config.security(), set_as_default=False
                )
            )
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise WorkspaceError(
                f"the scheduler at {address} does not answer ({why(error)}): start it with 'dask "
                "scheduler', or give the address that it prints"
            ) from None
        yield Connection(client=client, address=address, is_own=config.start is not None)


def read_cluster_file(path: Path) -> ClusterConfig:
    """Read a cluster file; one that ends with `.json` is Dask's file of a scheduler.

    Raises:
        ConfigError: it is missing, not TOML, or describes no cluster.
    """
    if path.suffix.lower() == ".json":
        return ClusterConfig(scheduler_file=path)
    try:
        config = ClusterConfig.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {why(error)}") from None
    except ValidationError as error:
        raise ConfigError(f"{path}: {first_fault(error)}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    given = [config.address, config.scheduler_file, config.start]
    if sum(value is not None for value in given) != 1:
        raise ConfigError(f"{path}: give one of address, scheduler_file and start")
    if config.start is None and (config.workers or config.options):
        raise ConfigError(f"{path}: workers and options are of a cluster to start: give start too")
    return config


@contextlib.contextmanager
def _start_cluster(config: ClusterConfig) -> Iterator[Any]:
    module, _, name = str(config.start).rpartition(".")
    try:
        kind = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError):
        raise ConfigError(
            f"start = {config.start!r} is not a class that can be imported here: give one such as "
            "'dask_jobqueue.SLURMCluster' (pip install dask-jobqueue) or 'distributed.LocalCluster'"
        ) from None
    security = config.security()
    options = {**_LOOPBACK.get(name, {}), **config.options}
    if security is not None:
        options["security"] = security
    try:
        cluster = kind(**options)
    except (TypeError, ValueError, OSError, RuntimeError) as error:
        raise ConfigError(f"{config.start} does not start: {error}") from None
    with cluster:
        yield cluster
