"""Scene files. Every format has a writer, a reader that shares no layout code with it, and writes all or nothing."""
