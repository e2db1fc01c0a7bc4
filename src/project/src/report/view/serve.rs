//! Answers over HTTP, on the loopback address only, and only to who knows the address with its token.
//!
//! One thread talks to all connections, some others make the answers. Nothing that a client does or leaves undone holds up another:
//! the head of a request, the number of connections and the time that a client takes to send and to read are limited, and a body is
//! refused but for marks that the page of this server puts.

use super::{Answer, Viewer, marks};
use hyper::{
    Method, Request, Response, StatusCode,
    body::{Body, Bytes, Frame, Incoming, SizeHint},
    header::{self, HeaderMap, HeaderName, HeaderValue},
    server::conn::http1,
    service::service_fn,
};
use hyper_util::rt::{TokioIo, TokioTimer};
use rowgram_base::error::Error;
use std::{
    convert::Infallible,
    fmt::Display,
    fs::File,
    future::{Future, poll_fn},
    io::{self, Read, Seek, SeekFrom},
    net::{Ipv4Addr, SocketAddr},
    path::Path,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpStream},
    runtime,
    sync::Semaphore,
    task,
    time::{Sleep, sleep, timeout},
};

/// Answers that are made at the same time.
const WORKERS: usize = 4;
/// Connections that are open at the same time; others wait.
const MAX_CONNECTIONS: usize = 64;
/// Largest head of a request, bytes, and most of its fields: browsers send less than 2 kB in 20.
const MAX_HEAD_BYTES: usize = 1 << 14;
const MAX_FIELDS: usize = 64;
/// Largest body, bytes: a hundred for each of 40 thousand marks.
const MAX_BODY_BYTES: usize = 1 << 22;
/// Longest time until a request has come, and until a client reads something of an answer.
const READ_TIMEOUT: Duration = Duration::from_secs(10);
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);
/// What is read of a file at a time, bytes.
const PIECE_BYTES: usize = 1 << 17;
/// What the page may load: what this server sends, and pictures within the page. Nothing that stands in the page itself is run.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// A server that listens.
pub struct Server {
    listener: std::net::TcpListener,
    address: SocketAddr,
    token: String,
}

impl Server {
    /// Listens on a port of the loopback address; 0 takes one that is free.
    ///
    /// # Errors
    /// A port that is taken or not allowed; a system without random numbers.
    pub fn listen(port: u16) -> Result<Server, Error> {
        let fault = |error: &dyn Display| {
            Error::Argument(format!(
                "port {port} of the loopback address cannot be used ({error}); another: --port 0"
            ))
        };
        let listener = std::net::TcpListener::bind((Ipv4Addr::LOCALHOST, port))
            .and_then(|listener| listener.set_nonblocking(true).map(|()| listener))
            .map_err(|error| fault(&error))?;
        let address = listener.local_addr().map_err(|error| fault(&error))?;
        let mut secret = [0; 16];
        getrandom::fill(&mut secret)
            .map_err(|error| Error::Incomplete(format!("no random numbers: {error}")))?;
        let token = secret.iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Server { listener, address, token })
    }

    /// What a browser is given. Other users of the machine can ask too, but do not know the token.
    pub fn url(&self) -> String {
        format!("http://{}/{}/", self.address, self.token)
    }
}

/// Answers requests until the program ends.
///
/// # Errors
/// A system that has no threads or sockets left.
pub fn serve(server: Server, viewer: Viewer) -> Result<(), Error> {
    let failed = |error: io::Error| Error::Incomplete(format!("the server cannot start: {error}"));
    let runtime = runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(WORKERS)
        .build()
        .map_err(failed)?;
    runtime.block_on(async {
        let listener = TcpListener::from_std(server.listener).map_err(failed)?;
        let site = Arc::new(Site { viewer, token: server.token });
        let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        while let Ok(place) = Arc::clone(&places).acquire_owned().await {
            let Ok((stream, _)) = listener.accept().await else {
                // Too many open files: some are closed soon.
                sleep(Duration::from_millis(100)).await;
                continue;
            };
            let site = Arc::clone(&site);
            task::spawn(async move {
                // A connection that breaks is none of the others' business.
                if let Err(error) = converse(stream, site).await {
                    tracing::debug!("connection ended: {error}");
                }
                drop(place);
            });
        }
        Ok(())
    })
}

async fn converse(stream: TcpStream, site: Arc<Site>) -> hyper::Result<()> {
    let service = service_fn(move |request| {
        let site = Arc::clone(&site);
        async move { Ok::<_, Infallible>(site.respond(request).await) }
    });
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(READ_TIMEOUT)
        .max_buf_size(MAX_HEAD_BYTES)
        .max_headers(MAX_FIELDS)
        .serve_connection(TokioIo::new(Timed { stream, waits: None }), service)
        .await
}

/// What is served, and the token that asks for it.
struct Site {
    viewer: Viewer,
    token: String,
}

impl Site {
    async fn respond(self: Arc<Site>, request: Request<Incoming>) -> Response<Payload> {
        let method = request.method().clone();
        let response = match self.refused(&request) {
            Some(refused) => in_memory(refused),
            None if method == Method::PUT => self.put(request).await,
            None => self.found(&request).await,
        };
        // The target is not logged: it has the token.
        tracing::debug!("{method}: {}", response.status());
        response
    }

    /// Why a request has no answer, if so.
    fn refused(&self, request: &Request<Incoming>) -> Option<Answer> {
        let (headers, uri) = (request.headers(), request.uri());
        // A page from elsewhere may have its name point to this machine; it cannot choose the header.
        let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
        let host = text(header::HOST);
        let named = uri.authority().map(|authority| authority.as_str());
        if !host.is_some_and(is_loopback) || !named.is_none_or(is_loopback) {
            return Some(Answer::failed(403, "ask for localhost or 127.0.0.1"));
        }
        let target = self.target(request);
        if request.method() == Method::PUT && target == Some(marks::TARGET) {
            let is_own = |origin: &str| origin.strip_prefix("http://") == host;
            if headers.contains_key(header::ORIGIN) && !text(header::ORIGIN).is_some_and(is_own) {
                return Some(Answer::failed(403, "marks are put by the page of this server only"));
            }
            if text(header::CONTENT_TYPE) != Some("application/json") {
                return Some(Answer::failed(415, "expected application/json"));
            }
            let length = text(header::CONTENT_LENGTH).and_then(|length| length.parse().ok());
            return match length {
                Some(0..=MAX_BODY_BYTES) => None,
                Some(_) => Some(Answer::failed(413, "these are too many changes at once")),
                None => Some(Answer::failed(411, "expected Content-Length")),
            };
        }
        if ![Method::GET, Method::HEAD].contains(request.method()) {
            return Some(Answer::failed(405, "only GET and HEAD"));
        }
        if !request.body().is_end_stream() {
            return Some(Answer::failed(413, "a request has no body here"));
        }
        target.is_none().then(|| Answer::failed(404, "there is nothing here"))
    }

    /// Path and query behind the token.
    fn target<'a>(&self, request: &'a Request<Incoming>) -> Option<&'a str> {
        let (token, target) =
            request.uri().path_and_query()?.as_str().strip_prefix('/')?.split_once('/')?;
        is_same(token.as_bytes(), self.token.as_bytes()).then_some(target)
    }

    async fn put(self: Arc<Site>, request: Request<Incoming>) -> Response<Payload> {
        let target = self.target(&request).unwrap_or_default().to_owned();
        let body = match timeout(READ_TIMEOUT, whole(request.into_body())).await {
            Ok(Some(body)) => body,
            _ => return in_memory(Answer::failed(408, "the request has not come to its end")),
        };
        let made = task::spawn_blocking(move || self.viewer.put(&target, &body));
        let nothing = || Answer::failed(404, "there is nothing here");
        match made.await {
            Ok(answer) => in_memory(answer.unwrap_or_else(nothing)),
            Err(_) => in_memory(Answer::failed(500, "it cannot be written")),
        }
    }

    async fn found(self: Arc<Site>, request: &Request<Incoming>) -> Response<Payload> {
        let target = self.target(request).unwrap_or_default().to_owned();
        let range = request.headers().get(header::RANGE).cloned();
        let made = task::spawn_blocking(move || match self.viewer.raster(&target) {
            Some(path) => part_of_file(path, range.as_ref()),
            None => Ok(in_memory(self.viewer.answer(&target))),
        });
        match made.await {
            Ok(Ok(response)) => response,
            // Where a file lies is nobody's business.
            Ok(Err(error)) => {
                tracing::warn!("not served: {error}");
                in_memory(Answer::failed(500, "the file cannot be read"))
            }
            // A file that a decoder does not survive.
            Err(_) => in_memory(Answer::failed(500, "it cannot be shown")),
        }
    }
}

/// All that a request has behind its head, no more than its head says; `None` where it breaks off.
async fn whole(mut body: Incoming) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    while let Some(frame) = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
        if let Ok(piece) = frame.ok()?.into_data() {
            bytes.extend_from_slice(&piece);
        }
    }
    Some(bytes)
}

/// Whether two texts are the same, in a time that does not tell where they differ.
fn is_same(one: &[u8], other: &[u8]) -> bool {
    one.len() == other.len() && one.iter().zip(other).fold(0, |all, (a, b)| all | (a ^ b)) == 0
}

/// Whether a `Host` header names this machine.
fn is_loopback(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.parse::<u16>().is_ok() => name,
        _ => host,
    };
    ["localhost", "127.0.0.1"].contains(&name)
}

fn with_headers(
    status: u16,
    media_type: &'static str,
    body: Payload,
    more: impl IntoIterator<Item = (HeaderName, HeaderValue)>,
) -> Response<Payload> {
    let mut response = Response::new(body);
    *response.status_mut() = StatusCode::from_u16(status).unwrap_or_default();
    let headers: &mut HeaderMap = response.headers_mut();
    let fixed = [
        (header::CONTENT_TYPE, media_type),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        // Nobody else learns of the token.
        (header::REFERRER_POLICY, "no-referrer"),
        // The next run of the project draws another map.
        (header::CACHE_CONTROL, "private, no-cache"),
    ];
    headers.extend(fixed.map(|(name, value)| (name, HeaderValue::from_static(value))));
    headers.extend(more);
    if status == 413 {
        headers.insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}

fn in_memory(answer: Answer) -> Response<Payload> {
    let body = Payload::Memory(Some(answer.body.into()));
    with_headers(answer.status, answer.media_type, body, [])
}

/// A raster, or the part of it that is asked for, as programs read cloud optimised files.
fn part_of_file(path: &Path, range: Option<&HeaderValue>) -> io::Result<Response<Payload>> {
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    let text = |text: String| HeaderValue::try_from(text).map_err(io::Error::other);
    let ranges = (header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    let media_type = "image/tiff";
    let asked = range.and_then(|range| range.to_str().ok()).and_then(one_range);
    let Some(asked) = asked else {
        let body = Payload::File { file, left: length };
        return Ok(with_headers(200, media_type, body, [ranges]));
    };
    let Some((first, count)) = asked.within(length) else {
        let none = (header::CONTENT_RANGE, text(format!("bytes */{length}"))?);
        return Ok(with_headers(416, media_type, Payload::Memory(None), [ranges, none]));
    };
    file.seek(SeekFrom::Start(first))?;
    let of = text(format!("bytes {first}-{}/{length}", first + count - 1))?;
    let body = Payload::File { file, left: count };
    Ok(with_headers(206, media_type, body, [ranges, (header::CONTENT_RANGE, of)]))
}

/// Bytes that are asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
enum ByteRange {
    /// From one to another, or to the end.
    From(u64, Option<u64>),
    /// So many at the end.
    Last(u64),
}

impl ByteRange {
    /// The first and how many there are in a file; `None` where there is none.
    fn within(self, length: u64) -> Option<(u64, u64)> {
        let (first, end) = match self {
            ByteRange::From(first, last) => {
                (first, last.map_or(length, |last| last.saturating_add(1).min(length)))
            }
            ByteRange::Last(count) => (length.saturating_sub(count), length),
        };
        end.checked_sub(first).filter(|&count| count > 0).map(|count| (first, count))
    }
}

/// The only range of a `Range` header; several, and what is none, are as if nothing was said.
fn one_range(text: &str) -> Option<ByteRange> {
    let (first, last) = text.trim().strip_prefix("bytes=")?.split_once('-')?;
    let number = |text: &str| text.trim().parse::<u64>().ok();
    match (first.trim(), last.trim()) {
        ("", count) => Some(ByteRange::Last(number(count)?)),
        (first, "") => Some(ByteRange::From(number(first)?, None)),
        (first, last) => {
            let (first, last) = (number(first)?, number(last)?);
            (first <= last).then_some(ByteRange::From(first, Some(last)))
        }
    }
}

/// What is sent: from memory, or from a file piece by piece.
enum Payload {
    Memory(Option<Bytes>),
    File { file: File, left: u64 },
}

impl Body for Payload {
    type Data = Bytes;
    type Error = io::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<io::Result<Frame<Bytes>>>> {
        Poll::Ready(match &mut *self {
            Payload::Memory(bytes) => bytes.take().map(|bytes| Ok(Frame::data(bytes))),
            Payload::File { left: 0, .. } => None,
            Payload::File { file, left } => {
                let count = (*left).min(PIECE_BYTES as u64);
                let mut piece = vec![0; count as usize];
                *left -= count;
                Some(file.read_exact(&mut piece).map(|()| Frame::data(piece.into())))
            }
        })
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::with_exact(match self {
            Payload::Memory(bytes) => bytes.as_ref().map_or(0, |bytes| bytes.len() as u64),
            Payload::File { left, .. } => *left,
        })
    }
}

/// A connection that ends when its client does not read what is sent.
struct Timed {
    stream: TcpStream,
    waits: Option<Pin<Box<Sleep>>>,
}

impl AsyncRead for Timed {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Timed {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        if written.is_ready() {
            self.waits = None;
            return written;
        }
        let waits = self.waits.get_or_insert_with(|| Box::pin(sleep(WRITE_TIMEOUT)));
        waits.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
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

    #[test]
    fn ranges_are_within_the_file() {
        let of = |text: &str| one_range(text).map(|range| range.within(100));
        assert_eq!(of("bytes=0-9"), Some(Some((0, 10))));
        assert_eq!(of("bytes=90-"), Some(Some((90, 10))));
        assert_eq!(of("bytes=-7"), Some(Some((93, 7))));
        assert_eq!(of("bytes=-700"), Some(Some((0, 100))));
        assert_eq!(of("bytes=99-18446744073709551615"), Some(Some((99, 1))));
        assert_eq!(of("bytes=100-"), Some(None));
        assert_eq!(of("bytes=-0"), Some(None));
        for none in ["bytes=5-4", "bytes=0-1,4-5", "bytes=a-b", "lines=0-1", "bytes=-", ""] {
            assert_eq!(of(none), None, "{none}");
        }
    }

    #[test]
    fn tokens_are_long_and_differ() {
        let [one, other] = [Server::listen(0).unwrap(), Server::listen(0).unwrap()];
        assert_eq!(one.token.len(), 32);
        assert_ne!(one.token, other.token);
        assert!(one.url().ends_with(&format!("/{}/", one.token)));
        assert!(is_same(b"ab", b"ab") && !is_same(b"ab", b"ac") && !is_same(b"ab", b"abc"));
    }
}
