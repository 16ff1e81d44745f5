//! Letters over HTTP.
