"""Camera poses from panoramas: features, relative poses of two views, tours of many views (docs/poses.md)."""
