"""The HTTP service: routes over sessions, maps, policies and training jobs."""
