"""The making of policies: jobs and workers."""

import os

from specshield.service.storage.connect import JOBS, is_cluster

if is_cluster(os.environ.get("REDIS_URL", "")):
    os.environ.setdefault("RQ_KEY_PREFIX", JOBS)  # rq reads this once, when it is imported
