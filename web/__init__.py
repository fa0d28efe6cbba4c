"""The operator page: plain HTML, CSS and ES modules, served by the daemon (:mod:`graderd.api.page`)."""
