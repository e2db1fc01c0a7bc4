//! Answers over HTTP, on the loopback address only.

use super::{Answer, Viewer};
use rowgram_base::error::Error;
use std::{
    net::{Ipv4Addr, SocketAddr},
    thread,
};
use tiny_http::{Header, Method, Request, Response};

/// Requests that are answered at the same time.
const WORKERS: usize = 4;

/// A server that listens.
pub struct Server {
    http: tiny_http::Server,
    address: SocketAddr,
}

impl Server {
    /// Listens on a port of the loopback address; 0 takes one that is free.
    ///
    /// # Errors
    /// A port that is taken or not allowed.
    pub fn listen(port: u16) -> Result<Server, Error> {
        let fault = |error: &dyn std::fmt::Display| {
            Error::Argument(format!(
                "port {port} of the loopback address cannot be used ({error}); another: --port 0"
            ))
        };
        let http =
            tiny_http::Server::http((Ipv4Addr::LOCALHOST, port)).map_err(|error| fault(&error))?;
        let address = http.server_addr().to_ip().ok_or_else(|| fault(&"no address"))?;
        Ok(Server { http, address })
    }

    /// What a browser is given.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }
}

/// Answers requests until the program ends.
pub fn serve(server: &Server, viewer: &Viewer) {
    thread::scope(|scope| {
        for _ in 0..WORKERS {
            scope.spawn(|| {
                // A connection that breaks is none of the others' business.
                while let Ok(request) = server.http.recv() {
                    let answer = answer(&request, viewer);
                    tracing::debug!("{} {}: {}", request.method(), request.url(), answer.status);
                    if let Err(error) = request.respond(response(answer)) {
                        tracing::debug!("not sent: {error}");
                    }
                }
            });
        }
    });
}

fn answer(request: &Request, viewer: &Viewer) -> Answer {
    // A page from elsewhere may have its name point to this machine; it cannot choose the header.
    let host = request.headers().iter().find(|header| header.field.equiv("Host"));
    if !host.is_some_and(|host| is_loopback(host.value.as_str())) {
        return Answer::failed(403, "ask for localhost or 127.0.0.1");
    }
    match request.method() {
        Method::Get | Method::Head => viewer.answer(request.url()),
        _ => Answer::failed(405, "only GET and HEAD"),
    }
}

/// Whether a `Host` header names this machine.
fn is_loopback(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.parse::<u16>().is_ok() => name,
        _ => host,
    };
    ["localhost", "127.0.0.1"].contains(&name)
}

fn response(answer: Answer) -> Response<std::io::Cursor<Vec<u8>>> {
    let policy = "default-src 'self' data:; script-src 'unsafe-inline'; style-src 'unsafe-inline'; frame-ancestors 'none'";
    let headers = [
        ("Content-Type", answer.media_type),
        ("Content-Security-Policy", policy),
        ("X-Content-Type-Options", "nosniff"),
        // The next run of the project draws another map.
        ("Cache-Control", "no-cache"),
    ];
    let headers = headers.iter().filter_map(|(name, value)| Header::from_bytes(*name, *value).ok());
    // Whole answers have their length in front.
    let response = Response::from_data(answer.body)
        .with_status_code(answer.status)
        .with_chunked_threshold(usize::MAX);
    headers.fold(response, Response::with_header)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_this_machine_is_meant() {
        for good in ["localhost", "localhost:8000", "127.0.0.1:65535", "127.0.0.1"] {
            assert!(is_loopback(good), "{good}");
        }
        for bad in
            ["", "evil.example", "localhost.evil.example:80", "127.0.0.1.evil:80", "10.0.0.1:80"]
        {
            assert!(!is_loopback(bad), "{bad}");
        }
    }
}
