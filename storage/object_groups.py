"""Arrays read where they lie in a bucket: one patch is one range of bytes, and the rest stays there."""

from __future__ import annotations

import zarr
from obstore.store import S3Store
from zarr.storage import ObjectStore

from pipeline.errors import IncompleteStoreError
from storage.addresses import in_text
from storage.object_places import connect
from storage.object_stores import Objects
from storage.object_transfers import files_at
from storage.staging import MANIFEST_NAME


def open_remote_group(objects: Objects, address: str) -> zarr.Group:
    """Open a Zarr group, such as ``stages/rectify/<key>/mosaic.zarr``, for reading from the bucket.

    Chunks are checked by their own crc32c, the files by no hash: `verify` does that.

    Raises
    ------
    IncompleteStoreError : there is no such store, or no readable group in it.
    UnreachableError : the bucket refuses or does not answer.
    """
    uri = in_text(address)
    text = None if uri is None else objects.read(f"{uri}/{MANIFEST_NAME}")
    if uri is None or text is None:
        raise IncompleteStoreError(f"{objects.place.url}/{address} is not there; ls lists what is")
    inside = address.removeprefix(uri).strip("/")
    store: ObjectStore[S3Store] = ObjectStore(connect(objects.place, f"{files_at(uri, text)}/{inside}"), read_only=True)
    try:
        return zarr.open_group(store, mode="r", zarr_format=3, use_consolidated=False)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise IncompleteStoreError(
            f"{objects.place.url}/{address} is no readable Zarr store ({error}); run verify on the archive"
        ) from error
